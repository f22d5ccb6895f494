"""Make rooms, maps, recordings and oracles that tests share."""
