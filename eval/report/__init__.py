"""Reports of sweeps: one page, its tables and figures, and what each environment adds to it."""
