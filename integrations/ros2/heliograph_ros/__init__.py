"""A node of ROS 2 that runs the filters of a network."""
