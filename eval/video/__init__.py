"""Videos and pictures of runs."""
