"""Agents of PointNav, ImageNav and LidarMaze."""
