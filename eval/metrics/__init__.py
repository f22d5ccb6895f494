"""Metrics of episodes and maps, their registry, and means with intervals."""
