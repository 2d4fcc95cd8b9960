"""Comparison of runs: what is read, statistics, figures and the report page."""
