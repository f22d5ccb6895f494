"""Feed damaged files to every reader: it reads or refuses each, within limits of time and memory."""
