"""Define tasks: starts and goals, path lengths through free space, coverage, surveys and reference flights."""
