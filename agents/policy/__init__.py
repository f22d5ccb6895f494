"""Run trained policies as agents: the agent, its files and its features."""
