"""Planning on beliefs: clearance, A*, path following."""
