"""Find a robot on a floor from nowhere: compare an image with panoramas of the map at every place and heading."""
