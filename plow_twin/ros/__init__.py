"""The twin as a ROS 2 node: parameters, messages, QoS and diagnostics, without computations."""
