"""Plan for a car: its footprint, hybrid A* with Reeds-Shepp curves, the dynamic window, pure pursuit."""
