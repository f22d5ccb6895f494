"""Count a motion several times where the map is not known."""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from vssm_gym.errors import InputError


class Counts(eqx.Module):
    """Hold how many motions one counts that begins at some poses of the grid, by its direction; one elsewhere."""

    poses: Bool[np.ndarray | Array, "nx ny headings"]
    number: Float[np.ndarray | Array, "2"]  # from 1: forwards, backwards

    def checked(self, shape: tuple[int, ...]) -> "Counts":
        """Return NumPy's bool and float32 arrays for a grid of this shape, else raise :class:`InputError`."""
        poses, number = np.asarray(self.poses), np.asarray(self.number, np.float32)
        if poses.shape != shape or poses.dtype != np.bool_:
            expected = f"bool of shape {shape}"
            raise InputError("value iteration", "counts.poses", f"{expected}; found {poses.dtype} {poses.shape}")
        if number.shape != (2,) or not (np.isfinite(number).all() and number.min() >= 1.0):
            raise InputError("value iteration", "counts.number", f"two finite numbers from 1; found {number!r:.80}")
        return Counts(poses, number)
