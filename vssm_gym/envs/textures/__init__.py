"""Define procedural textures: their registry, band-limited noise, and motifs with colours of their own."""
