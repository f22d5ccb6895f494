"""Plan where to explore: frontiers, candidate viewpoints, the building prior, information, the order of visits."""
