"""Inputs of a live twin without ROS: files, standard input and MQTT, read by the same mapping as recordings."""
