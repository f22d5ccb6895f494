"""Share parts among agents: localisation, mapping, and the drivers that turn plans into commands."""
