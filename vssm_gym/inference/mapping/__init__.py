"""Update the map from posed images: closed-form updates, learning through the renderer, a rolling window."""
