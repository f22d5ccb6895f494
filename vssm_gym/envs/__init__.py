"""Simulate furnished apartments as Gymnasium environments."""
