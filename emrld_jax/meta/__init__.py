"""Meta-learning: inner steps, an outer objective and an outer optimizer, in one loop."""
