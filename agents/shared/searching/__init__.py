"""Search an unknown apartment for the place of a picture: what to look at next, and where the map shows the picture."""
