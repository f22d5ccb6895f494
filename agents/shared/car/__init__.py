"""Hold what the agents of the car share: the driver, its critics, parking, and responses to failures."""
