"""The live twin apart from its transport: session, recording, wear, alarms, health; inputs without ROS."""
