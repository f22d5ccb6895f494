"""Define gravity, which the simulated IMU, the multirotor and the IMU's transition share."""

GRAVITY = (0.0, 0.0, -9.81)  # m/s^2, world: the mean at the Earth's surface
