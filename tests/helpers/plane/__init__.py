"""Scans of rooms in the plane, and episodes of mazes."""
