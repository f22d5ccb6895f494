"""Agents: one agent, one file; `base` is the protocol they share."""
