"""Episode protocols: how the episodes of each environment are set, run and judged."""
