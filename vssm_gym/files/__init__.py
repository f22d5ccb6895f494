"""Write files atomically; read users' files within bounds of size, nesting and unpacking, and check their numbers."""
