"""Agents of PointNav and ImageNav."""
