"""Built-in apartments and frozen tasks."""
