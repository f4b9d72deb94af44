"""The twin as a ROS 2 node: parameters, messages, QoS, diagnostics; glue only."""
