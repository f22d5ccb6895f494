"""Run SLAM on recordings: the loop, its output folder and report, trajectory errors, and maps from known poses."""
