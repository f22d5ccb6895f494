"""Rooms, maps, recordings and oracles that tests share."""
