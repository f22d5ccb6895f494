"""Recorded sequences on disk."""
