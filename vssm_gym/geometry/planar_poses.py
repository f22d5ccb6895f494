"""Compose poses of the plane: x, y (m), heading (rad)."""

import numpy as np
from jaxtyping import Float

from vssm_gym.geometry.transforms import wrap_angle


def compose(
    pose: Float[np.ndarray, "*batch 3"], motion: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Return the pose that is ``motion`` (forward, left, turn) away from ``pose`` (x, y, heading)."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + c * motion[..., 0] - s * motion[..., 1]
    y = pose[..., 1] + s * motion[..., 0] + c * motion[..., 1]
    return np.stack([x, y, np.asarray(wrap_angle(pose[..., 2] + motion[..., 2]))], axis=-1)


def relation(
    pose: Float[np.ndarray, "*batch 3"], other: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Return ``other`` seen from ``pose``: forward, left, turn."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    dx, dy = other[..., 0] - pose[..., 0], other[..., 1] - pose[..., 1]
    turn = np.asarray(wrap_angle(other[..., 2] - pose[..., 2]))
    return np.stack([c * dx + s * dy, c * dy - s * dx, turn], axis=-1)
