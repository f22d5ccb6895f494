"""Draw furniture: one file a kind of room, each function one piece in its own frame."""
