"""Bridges between policies and robots; none is built yet."""
