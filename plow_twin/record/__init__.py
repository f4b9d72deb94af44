"""Runs to MCAP and back: messages, recorder, reader and replay."""
