"""Notice frozen images: they repeat although the robot was commanded to move.

    p_k = erfc(d_k / sqrt 2),   d_k^2 = m_k^T Q_k^-1 m_k,   suspect where  prod_k p_k < FrozenConfig.suspect

``m_k`` is the motion that command ``k`` asks for, ``Q_k`` the covariance of its noise, and ``p_k`` the probability of
an error as large as the whole motion. A live camera repeats its image only while the robot stands: ``p_k = 1`` where
it was commanded to stand, so that a standing robot's images may repeat for ever. An obstacle may hold a robot in its
place too, but it does not keep it from turning: only commands to turn prove that the camera failed. The same product
over the commanded turns alone has to fall below ``FrozenConfig.frozen`` for that.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.model.transition.base import Transition

IMAGE = ("rgb", "depth")  # the entries of an observation that a frozen camera repeats


class Liveness(Enum):
    """Enumerate what the repetition of an image says about the camera."""

    LIVE = "live"  # a new image, or one that may repeat because the robot stands
    SUSPECT = "suspect"  # the camera is frozen, or something holds the robot
    FROZEN = "frozen"


@dataclass(frozen=True)
class FrozenConfig:
    """Configure how much evidence is asked for."""

    suspect: float = 1e-3  # probability that the robot stands in spite of its commands
    # Probability that it was not turned in spite of them. It then stands for good, and chance must not cause that: at
    # noise high a tenth of the turns of 0.2 rad is not carried out, and four in a row are not in one of 10,000.
    frozen: float = 1e-6
    # Repeated images at least. The navigator notices within three full steps that something holds its robot.
    images: int = 4


class FrozenImages:
    """Compare each image with the one before.

    Args:
        transition: of a robot whose state is ``(x, y, heading)`` and whose controls are commands.
        dt: length of a step, s.
        config: evidence asked for.
    """

    def __init__(self, transition: Transition, dt: float, config: FrozenConfig) -> None:
        self._transition, self._dt, self._config = transition, dt, config
        self._still(np.zeros(transition.controls))  # compiled here, so that it delays no step

    def reset(self, observation: Mapping[str, np.ndarray]) -> None:
        """Begin with the first image."""
        self._image = [np.array(observation[name]) for name in IMAGE]
        self.repeats = 0  # of this image, after commands to move and to stand
        self._moves = 0  # commands to move among them
        self._held = self._unturned = 1.0  # probabilities that none of them moved the robot, and that none turned it

    def update(self, command: np.ndarray, observation: Mapping[str, np.ndarray]) -> Liveness:
        """Judge the image that followed ``command``."""
        # Depth may be NaN where there is no reading, and NaN repeats, too.
        repeats = (np.array_equal(old, observation[name], True) for old, name in zip(self._image, IMAGE, strict=True))
        if not all(repeats):
            self.reset(observation)
            return Liveness.LIVE
        held, unturned = self._still(command)
        self._held, self._unturned = self._held * held, self._unturned * unturned
        self.repeats, self._moves = self.repeats + 1, self._moves + (held < 1.0)
        if self._moves < self._config.images or self._held >= self._config.suspect:
            return Liveness.LIVE
        return Liveness.FROZEN if self._unturned < self._config.frozen else Liveness.SUSPECT

    def _still(self, command: np.ndarray) -> tuple[float, float]:
        """Return the probabilities of errors as large as the commanded motion, and as the commanded turn."""
        d_motion, d_turn = _deviations(self._transition, jnp.asarray(command, jnp.float32), self._dt)
        return math.erfc(float(d_motion) / math.sqrt(2.0)), math.erfc(float(d_turn) / math.sqrt(2.0))


@jax.jit
def _deviations(transition: Transition, control: jax.Array, dt: float) -> tuple[jax.Array, jax.Array]:
    """Return the commanded motion and the commanded turn in standard deviations of their noise."""
    origin = jnp.zeros(3)
    motion = transition.manifold.error(origin, transition.mean(origin, control, dt))
    Q = transition.noise_covariance(origin, control, dt)
    return jnp.sqrt(motion @ jnp.linalg.solve(Q, motion)), jnp.abs(motion[2]) / jnp.sqrt(Q[2, 2])
