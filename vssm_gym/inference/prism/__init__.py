"""Implement PRISM: the filter over state and map, its configuration, its drift and its control from an IMU."""
