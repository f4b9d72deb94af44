"""Values of an OPC UA server as messages."""
