"""Parts that several commands share: the compilation cache, progress and tables, the terminal."""
