"""Compare posterior families of a camera that sees a ball and cannot say from which side."""
