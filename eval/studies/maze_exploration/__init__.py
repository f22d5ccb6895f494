"""Compare explorers of the mazes of LidarMaze: information from samples, frontiers, a trained policy, chance."""
