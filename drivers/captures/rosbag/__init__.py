"""Readers of ROS 1 and ROS 2 bags: the units of devices in their messages."""
