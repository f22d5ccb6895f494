"""Geometry that everything stands on: rigid motions, the camera, arcs of wheeled robots, grids in the plane."""
