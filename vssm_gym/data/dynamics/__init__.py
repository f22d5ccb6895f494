"""Read logs of poses and controls, from which transitions are learned."""
