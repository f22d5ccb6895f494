"""Plan where to explore: frontiers, candidate viewpoints, what unknown space may hold, the order of visits."""
