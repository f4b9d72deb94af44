"""The ROS 2 node of the twin: parameters, messages, quality of service and diagnostics."""
