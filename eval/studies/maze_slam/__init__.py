"""Compare SLAM in the plane on scripted traversals of the mazes: odometry, occupancy, latent grid, pose graph."""
