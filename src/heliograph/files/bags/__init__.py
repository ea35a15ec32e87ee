"""Bags of ROS: read by the sources of a network, and written with its estimates."""
