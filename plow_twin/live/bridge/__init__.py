"""Inputs of a live twin without ROS: files, standard input and MQTT, by the mapping that recordings use too."""
