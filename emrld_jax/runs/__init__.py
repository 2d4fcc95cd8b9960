"""Runs: configuration, folders, checkpoints, metrics, pictures. Files and clocks live here."""
