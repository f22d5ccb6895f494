"""Agents of Explore."""
