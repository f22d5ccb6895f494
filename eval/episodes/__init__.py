"""Episodes of sweeps: what identifies one, its row, the log of rows, and the manifest of a sweep."""
