"""The live twin without a transport: session, recording, wear, alarms, health; and what feeds it without ROS."""
