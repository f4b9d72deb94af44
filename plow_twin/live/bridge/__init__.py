"""Inputs of a live twin without ROS: files, standard input and MQTT, by the mapping of recordings."""
