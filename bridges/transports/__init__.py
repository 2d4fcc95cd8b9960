"""Ways to reach a robot: rclpy, DDS without ROS, and memory."""
