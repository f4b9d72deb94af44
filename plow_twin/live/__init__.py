"""The parts of the live twin that do not use ROS: session, recording, wear, alarms, diagnostics, and file inputs."""
