"""Outputs to a plant: the twin's results by MQTT, Sparkplug B, InfluxDB and OPC UA, each from its own process."""
