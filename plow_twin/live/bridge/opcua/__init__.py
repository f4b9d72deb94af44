"""Receive samples from an OPC UA server."""
