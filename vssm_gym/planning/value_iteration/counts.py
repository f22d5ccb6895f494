"""Count a motion several times where the map is not known."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float


class Counts(eqx.Module):
    """Hold how many motions one counts from some poses of the grid, by its direction; from the others one."""

    poses: Bool[np.ndarray, "nx ny headings"]
    number: Float[np.ndarray, "2"]  # float32, from 1: forwards, backwards
