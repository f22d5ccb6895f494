"""Share parts among commands: the compilation cache, arguments, progress bars, tables, the terminal."""
