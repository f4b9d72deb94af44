"""The live twin apart from ROS: session, recording, wear, alarms, diagnostics, and inputs without ROS."""
