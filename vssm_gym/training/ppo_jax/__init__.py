"""Train by proximal policy optimisation in one compiled program: robots, policy and updates without a copy to NumPy."""
