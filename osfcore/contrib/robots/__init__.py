"""Robots over HTTP and ROS as worlds, with limits, a stop and a permission before the first motion."""
