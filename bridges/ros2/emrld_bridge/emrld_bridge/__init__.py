"""Policies of emrld-jax on a TurtleBot3, as nodes of ROS 2."""
