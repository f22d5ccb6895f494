"""Procedural textures: their registry, band-limited noise, and motifs with their own colours."""
