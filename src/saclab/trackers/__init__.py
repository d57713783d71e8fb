"""Experiment trackers: they read a run's events and nothing else. Each is an optional extra."""
