"""Results as an OPC UA server: a device type based on OPC UA's mining model, and alarms as conditions."""
