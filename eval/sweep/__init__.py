"""Sweeps: configurations, workers, shards, and the log of episodes."""
