"""Define the agents: one agent, one file; `base` is the protocol that they share."""
