"""Agents of CarNav."""
