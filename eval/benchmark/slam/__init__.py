"""Score SLAM methods on recordings: what a method has to offer, those of the package, and one run."""
