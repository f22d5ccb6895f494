"""Plan paths, drives, control and exploration on the belief over the map."""
