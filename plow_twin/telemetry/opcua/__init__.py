"""OPC UA server for the results: a device type based on the OPC UA mining model, and alarms as conditions."""
