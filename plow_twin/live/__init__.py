"""The live twin without a transport: session, recording, wear, alarms, health; and its inputs without ROS."""
