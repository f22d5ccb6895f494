"""Scenes: apartments as data, their solids and free space, files, splits, importers and the generator."""
