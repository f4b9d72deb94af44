"""Outputs to a plant: the twin's results to MQTT, Sparkplug B, InfluxDB and OPC UA, each by a process of its own."""
