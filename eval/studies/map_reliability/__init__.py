"""Compare the error of learned maps' surfaces with the std that they state."""
