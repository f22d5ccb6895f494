"""The dense map: a voxel grid of independent Gaussians, its storage, its index of empty space and its files."""
