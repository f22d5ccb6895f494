"""Infer the pose of a maze's robot together with the map of its plane, scan by scan, from scans and commands alone.

It is :class:`~vssm_gym.inference.planar.PlanarPrism` from a known start. Its map is written to the end of every beam:
pose and driving rest on all that was seen. What an explorer counts as known is a second map, of the same scans at the
same poses up to ``reach`` only, two body lengths: every cell of it was crossed by a beam or two. In DVBF-LM likewise a
scan informs only the map around the robot's place, so that a map is learned where the robot has been.
"""

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.agents.base import AgentContext, Observation
from vssm_gym.inference.planar import PlanarPrism, PlanarState
from vssm_gym.inference.planar.config import PlanarConfig
from vssm_gym.inference.planar.scan_update import update
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_STD
from vssm_gym.model.scan_emission import render_scan
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief
from vssm_gym.model.transition.belief import GaussianBelief

MINDED = 0.1  # m, up to which surfaces matter to the next step
STARTS_KNOWN = 1e-3  # m, rad: standard deviation of the start pose, which an agent is given


@dataclass(frozen=True)
class ScanMapperConfig:
    """Configure the map; lengths in metres.

    Args:
        cell: of the map.
        low: x and y of the map's first cell; mazes lie in the unit square.
        high: x and y beyond which it ends.
        longest: reach of the map of all that was seen.
        reach: of the map of what is known: 64 beams are half a cell apart there.
        slip: standard deviations a step that contacts add to the motion: forward, left (m), turn (rad).
        prism: of the filter.
    """

    cell: float = 0.01
    low: float = -0.04
    high: float = 1.04
    longest: float = 1.5
    reach: float = 0.05
    slip: tuple[float, float, float] = (0.002, 0.002, 0.002)
    prism: PlanarConfig = field(default_factory=PlanarConfig)


class ScanMapper:
    """Hold ``q(z_t) q(M)`` of a robot in a maze and keep it up to date; ``map`` is what is known of it."""

    def __init__(self, config: ScanMapperConfig | None = None) -> None:
        self.config = config or ScanMapperConfig()

    def reset(self, context: AgentContext, observation: Observation) -> None:
        """Begin at the start pose with a map of which nothing is known, and write the first scan into it."""
        c, scan = self.config, np.asarray(observation["scan"], np.float32)
        self.scanner, self._near = (scanner_of(len(scan), reach) for reach in (c.longest, c.reach))
        self._minded = scanner_of(len(scan), MINDED)
        self.transition = Planar(MotionNoise(*map(float, context.noise)), c.slip)
        start = jnp.asarray(context.start_pose, jnp.float32)
        belief = planar_belief(start, STARTS_KNOWN**2 * jnp.eye(3))
        m = PlanarMap.prior(np.full(2, c.low), np.full(2, c.high), c.cell)
        prism = PlanarPrism(self.scanner, self.transition, c.prism)
        self.state, self.dt = prism.init(belief, m, jnp.asarray(scan)), context.dt
        self.map = update(m, jnp.asarray(scan), start, self._near, c.prism)

    def observe(self, command: Float[np.ndarray, "2"], observation: Observation) -> None:
        """Update pose and map by a command ``(turn rad, step m)`` and the scan after it."""
        control = jnp.asarray([command[0], 0.0, command[1]], jnp.float32)
        ranges = jnp.asarray(observation["scan"], jnp.float32)
        given = self.config.prism, self.state, self.map, control, ranges, self.dt
        self.state, self.map = _step(self.scanner, self._near, self.transition, *given)

    @property
    def belief(self) -> GaussianBelief:
        """Return ``q(z_t)``."""
        return self.state.belief

    @property
    def pose(self) -> Float[np.ndarray, "3"]:
        """Return its mean: x, y (m), heading (rad)."""
        return np.asarray(self.state.belief.mean, np.float64)

    def smooth_scan(self) -> Float[np.ndarray, "beams"]:
        """Return the ranges, m, up to :data:`MINDED`, that the map of what was seen predicts here: without noise."""
        found = _predicted(self._minded, self.state)
        return np.asarray(found, np.float64)

    @property
    def seen(self) -> PlanarMap:
        """Return the map of all that was seen, by which the robot tracks its pose and finds its way."""
        return self.state.m


def scanner_of(beams: int, reach: float) -> Scanner:
    """Return a scanner of a full circle, beam 0 ahead, in the middle of the robot."""
    angles = jnp.asarray(2.0 * np.pi * np.arange(beams) / beams, jnp.float32)
    return Scanner(angles, jnp.zeros(3), jnp.float32(reach))


def planar_entropy(m: PlanarMap) -> float:
    """``H(M) - H(prior) = sum_cells 1/2 log(lambda_0 / lambda)``, nats; 0 of an empty map, negative of others."""
    return 0.5 * float(np.sum(np.log(PRIOR_OCCUPANCY_STD**-2 / np.asarray(m.precision, np.float64))))


@partial(jax.jit, static_argnames="config")
def _step(
    scanner: Scanner,
    near: Scanner,
    transition: Planar,
    config: PlanarConfig,
    state: PlanarState,
    known: PlanarMap,
    control: Array,
    ranges: Array,
    dt: float,
) -> tuple[PlanarState, PlanarMap]:
    state = PlanarPrism(scanner, transition, config).step(state, control, ranges, dt)[0]
    return state, update(known, ranges, state.belief.mean, near, config)


@jax.jit
def _predicted(scanner: Scanner, state: PlanarState) -> Array:
    return render_scan(state.m, scanner, state.belief.mean)
