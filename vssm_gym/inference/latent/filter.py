"""Move particles of the pose and weigh them by the charts that they see; smooth the moments of a pass backwards.

w_k ∝ p(x_t | z_k, M),  z_k ~ p(z_t | z_t-1, u_t-1),    q^(z_t) = N(moments of the particles)
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.inference.latent.chart_update import ChartSensor
from vssm_gym.inference.particles import BootstrapFilter, ParticleBelief, Weighted
from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import PLANAR


@dataclass(frozen=True)
class LatentFilter:
    """Filter the pose of a robot in the plane under a latent map.

    Attributes:
        charts: relation of the sensor to the map.
        transition: of the robot, in the plane.
    """

    charts: ChartSensor
    transition: Transition

    def __post_init__(self) -> None:
        if self.transition.manifold != PLANAR:
            found = type(self.transition).__name__
            raise InputError("LatentFilter", "transition", f"one of a robot in the plane; found {found}")

    def step(
        self,
        key: PRNGKeyArray,
        belief: ParticleBelief,
        m: LatentGrid,
        control: Float[Array, "m"],
        reading: Any,
        dt: float | Array,
    ) -> Weighted:
        """Return the particles after one more control and one more reading, and the reading's evidence.

        Args:
            key: random key.
            belief: before them.
            m: the map, without what the steps close by have written.
            control: of the transition.
            reading: of the sensor.
            dt: length of the step, s.
        """
        likelihood = self.charts.likelihood(m, reading)
        return BootstrapFilter(self.transition).step(key, belief, control, likelihood, dt)


def smoothed(
    transition: Transition,
    mean: Float[Array, "time 3"],
    covariance: Float[Array, "time 3 3"],
    controls: Float[Array, "steps m"],
    dt: float | Array,
) -> tuple[Float[Array, "time 3"], Float[Array, "time 3 3"]]:
    """Return the moments given all scans from those given the scans so far (Rauch, Tung and Striebel, 1965; eq. I75).

    Args:
        transition: between the steps.
        mean: of each filtered belief: x, y (m), heading (rad).
        covariance: of each one's error.
        controls: one fewer.
        dt: length of a step, s.
    """

    def back(
        after: tuple[Array, Array], now: tuple[Array, Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        z, P, control = now
        predicted = transition.predict(GaussianBelief(z, P, PLANAR), control, dt)
        F = transition.jacobian(z, control, dt)
        gain = jnp.linalg.solve(predicted.covariance, F @ P).T
        found = PLANAR.perturb(z, gain @ PLANAR.error(predicted.mean, after[0]))
        spread = P + gain @ (after[1] - predicted.covariance) @ gain.T
        both = found, 0.5 * (spread + spread.T)
        return both, both

    last = mean[-1], covariance[-1]
    _, (earlier, of_earlier) = jax.lax.scan(back, last, (mean[:-1], covariance[:-1], controls), reverse=True)
    return jnp.concatenate([earlier, last[0][None]]), jnp.concatenate([of_earlier, last[1][None]])
