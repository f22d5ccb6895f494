"""Score world models by the density of what they predict: those of the package, and one run."""
