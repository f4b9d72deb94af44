"""OPC UA server for the results. It has a device type from the OPC UA mining model, and alarms as conditions."""
