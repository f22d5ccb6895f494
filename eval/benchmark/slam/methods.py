"""List the SLAM methods of the package that enter the benchmark by name."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.eval.benchmark.slam.contract import SlamMethod
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.tracking.localise import readable
from vssm_gym.model.emission import RGBD
from vssm_gym.slam.options import SlamOptions

NO_CONTROL = 6  # zeros: a hand-held camera keeps its velocity


class PrismMethod:
    """Filter pose and map, as ``vssm-gym slam`` does."""

    name = "prism"

    def begin(self, camera: Camera, seed: int) -> None:
        """Make the filter for a camera."""
        self._options = SlamOptions(size=(camera.width, camera.height), seed=seed, method="prism")
        self._filter = self._options.filter(camera)
        self._state: Any = None
        self._time = 0.0

    def track(self, time: float, rgb: np.ndarray, depth: np.ndarray) -> Float[np.ndarray, "4 4"]:
        """Filter an image; the map begins at the first one that can be read."""
        image = RGBD.from_camera(rgb, depth)
        if self._state is not None:
            self._state, _ = self._filter.step(self._state, jnp.zeros(NO_CONTROL), image, time - self._time)
        elif readable(image, self._options.tracking):
            self._state = self._filter.init(self._options.prior(), image, jax.random.key(self._options.seed))
        self._time = time
        if self._state is None:
            return np.eye(4)
        mean: Any = self._filter.posterior(self._state).belief.mean
        return np.asarray(mean.T_world_body, float)

    def finish(self) -> None:
        """Keep the poses that were returned."""


class StandingStill:
    """Believe that the camera never moves: the score of a method that sees nothing."""

    name = "standing_still"

    def begin(self, camera: Camera, seed: int) -> None:
        """Need nothing."""

    def track(self, time: float, rgb: np.ndarray, depth: np.ndarray) -> Float[np.ndarray, "4 4"]:
        """Return the first pose."""
        return np.eye(4)

    def finish(self) -> None:
        """Keep it."""


SLAM_METHODS: dict[str, Callable[[], SlamMethod]] = {method.name: method for method in (PrismMethod, StandingStill)}
