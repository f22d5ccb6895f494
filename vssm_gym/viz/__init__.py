"""Draw maps, images and runs."""
