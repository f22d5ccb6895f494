"""Store the dense map: a voxel grid of independent Gaussians, its index of empty space and its files."""
