"""Simulated apartments and the Gymnasium environments in them."""
