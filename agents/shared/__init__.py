"""Parts that agents share: localisation, mapping, and the drivers that turn plans into commands."""
