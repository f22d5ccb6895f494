"""Define scenes: apartments as data, their solids and free space, files, importers and the generator."""
