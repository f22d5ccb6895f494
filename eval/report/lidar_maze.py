"""Define LidarMaze's report: PointNav's without learned maps, with lengths to the centimetre."""

from dataclasses import replace

from vssm_gym.eval.report.view import POINTNAV_VIEW

LIDAR_MAZE_VIEW = replace(
    POINTNAV_VIEW,
    template="lidar_maze.html.j2",
    voxel_maps=False,
    conditions=("robot", "noise", "sensor_noise"),
    numbers=lambda row: f"{row['steps']} steps, {row['path_length']:.2f} m of {row['geodesic']:.2f} m",
)
