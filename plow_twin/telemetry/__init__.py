"""Outputs to a plant: the twin's results by MQTT, Sparkplug B, InfluxDB and OPC UA, each sent by a separate process."""
