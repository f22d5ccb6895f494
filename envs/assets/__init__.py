"""Hold the built-in apartments and frozen tasks."""
