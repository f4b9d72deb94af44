"""The twin as a ROS 2 node: parameters, messages, quality of service and diagnostics, without computations."""
