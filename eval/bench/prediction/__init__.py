"""Score the predictions of spatial world models: images and poses seconds ahead, given past images and commands."""
