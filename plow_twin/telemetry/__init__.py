"""Outputs of the twin's results to a plant by MQTT, Sparkplug B, InfluxDB and OPC UA, each in a separate process."""
