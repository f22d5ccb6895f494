"""Searches over the 16-neighbour graph of a clearance grid: what is asked of them, and what they share."""
