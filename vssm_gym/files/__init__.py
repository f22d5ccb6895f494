"""Write files atomically; read users' files within bounds of size, nesting and unpacking, and judge their numbers."""
