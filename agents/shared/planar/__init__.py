"""Parts of agents with a laser scanner in a maze: the map and pose that they infer, and how they follow paths."""
