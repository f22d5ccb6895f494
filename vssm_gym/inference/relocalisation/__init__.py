"""Find a robot on a floor from nowhere: panoramas of the map, to which an image is compared at every place and heading."""
