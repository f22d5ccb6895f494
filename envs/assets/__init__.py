"""Hold the built-in apartments, frozen tasks, a learned map and trained policies."""
