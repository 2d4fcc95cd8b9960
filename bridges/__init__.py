"""Trained policies on robots: bundles, transports, the control loop, a simulated TurtleBot3."""
