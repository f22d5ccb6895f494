"""Define the geometry of all layers: rigid motions, the camera, arcs of wheeled robots, grids in the plane."""
