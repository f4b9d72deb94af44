"""Inputs of a live twin without ROS: files, standard input, MQTT and OPC UA.

A mapping assigns a role, such as the load, to each value in a message.
"""
