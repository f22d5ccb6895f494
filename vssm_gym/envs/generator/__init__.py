"""Apartments from code: the seeded generator, the catalogue of furniture and the plans of the built-in scenes."""
