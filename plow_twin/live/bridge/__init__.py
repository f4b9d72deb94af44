"""Inputs of a live twin without ROS: files, standard input, MQTT and OPC UA. A mapping gives each value its role."""
