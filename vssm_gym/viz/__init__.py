"""Pictures of maps, images and runs."""
