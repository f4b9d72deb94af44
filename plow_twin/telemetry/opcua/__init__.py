"""Results as an OPC UA server: a device type of the mining model, and alarms as conditions."""
