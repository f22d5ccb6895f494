"""Record, read and write sequences on disk."""
