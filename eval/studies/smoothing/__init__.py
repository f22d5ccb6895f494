"""Compare the smoother with the filter that it starts from."""
