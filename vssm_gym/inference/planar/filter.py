"""Track a robot and map its plane in real time: predict, align the scan to the map, write it into the map (eq. I73)."""

from dataclasses import dataclass, field
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.inference.planar.config import PlanarConfig
from vssm_gym.inference.planar.scan_alignment import align
from vssm_gym.inference.planar.scan_update import update
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import PLANAR

LEAST_SCAN_STD = 1e-7  # m, rad, added to predictions so that those of an exact motion have an inverse


class PlanarState(eqx.Module):
    """Hold ``q(z_t) q(M)``."""

    belief: GaussianBelief
    m: PlanarMap


class ScanInfo(NamedTuple):
    """Report a step."""

    prediction: GaussianBelief
    used: Float[Array, ""]  # share of the readings that met a known surface


@dataclass(frozen=True)
class PlanarPrism:
    """Filter pose and map of a robot in the plane (PRISM, with scans for images).

    Attributes:
        scanner: on the robot.
        transition: of the robot, in the plane.
        config: of alignment and update.
    """

    scanner: Scanner
    transition: Transition
    config: PlanarConfig = field(default_factory=PlanarConfig)

    def __post_init__(self) -> None:
        if self.transition.manifold != PLANAR:
            found = type(self.transition).__name__
            raise InputError("PlanarPrism", "transition", f"one of a robot in the plane; found {found}")

    def init(self, belief: GaussianBelief, m: PlanarMap, ranges: Float[Array, "beams"]) -> PlanarState:
        """Return the state after the first scan, taken where the belief has the robot."""
        return PlanarState(belief, update(m, ranges, belief.mean, self.scanner, self.config))

    def step(
        self, state: PlanarState, control: Float[Array, "m"], ranges: Float[Array, "beams"], dt: float | Array
    ) -> tuple[PlanarState, ScanInfo]:
        """Return the state after one more control and one more scan.

        Args:
            state: before them.
            control: of the transition.
            ranges: of the scan, m; 0 where there is no reading.
            dt: length of the step, s.
        """
        predicted = self.transition.predict(state.belief, control, dt)
        slack = LEAST_SCAN_STD**2 * jnp.eye(3)
        predicted = GaussianBelief(predicted.mean, predicted.covariance + slack, PLANAR)
        found = align(state.m, ranges, predicted, self.scanner, self.config)
        m = update(state.m, ranges, found.belief.mean, self.scanner, self.config)
        return PlanarState(found.belief, m), ScanInfo(predicted, found.used)
