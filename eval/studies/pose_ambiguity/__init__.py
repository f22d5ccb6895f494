"""Show the posterior of a robot that could be in several places of a known map, and how it collapses."""
