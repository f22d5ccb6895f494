"""PRISM: the filter over state and map, its configuration, its process noise and its control from an IMU."""
