"""Navigate by a model of laser scans: the pose by particles, plans by hybrid A*, and following them."""
