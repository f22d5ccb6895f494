"""Render apartments: ray casting, rasterisation, textures, shading, and plans from above."""
