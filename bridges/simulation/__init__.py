"""A simulated TurtleBot3: how it moves, what it hears and tells, and its page in a browser."""
