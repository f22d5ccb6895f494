"""Model a differential drive: ``p(z' | z, u)`` of ``(x, y, heading)``, the point between the wheels.

    T' = T exp(s, 0, turn),   s = (l + r) / 2,   turn = (r - l) / track
    l' = sign(l) max(0, |l| + e_l),   e_l ~ N(0, (slip l)^2 + play^2)        where l != 0, and r alike

Control ``u = (l, r)``: how far the left and the right wheel roll in a step, m, negative backwards. Noise acts only on
a wheel that is driven and never reverses it. :meth:`DifferentialDrive.executed` implements this noise; the simulator
has a NumPy twin of it, which a test compares with this one.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.arc import arc_of
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.rectified import rectified


class DifferentialNoise(eqx.Module):
    """Hold standard deviations of each wheel's travel in a step, as the robot believes them.

    Attributes:
        slip: proportion of the travel.
        play: of a step however short, m.
    """

    slip: Float[Array, ""] | float
    play: Float[Array, ""] | float

    def stds(self, travel: Float[Array, "*batch 2"]) -> Float[Array, "*batch 2"]:
        """Return the standard deviations of both wheels.

        Args:
            travel: of the left and the right wheel, m.

        Returns:
            Of the same wheels, m; zero for a wheel at rest.
        """
        driven = travel != 0.0
        safe = jnp.where(driven, travel, 1.0)  # the root has no derivative at zero
        return jnp.where(driven, jnp.sqrt((self.slip * safe) ** 2 + self.play**2), 0.0)


class DifferentialDrive(Transition):
    """Model a robot on two wheels.

    States are ``(x, y, heading)`` of the point between the wheels in the world, m and rad. Controls are ``(left,
    right)``: the travel of each wheel in a step, m, negative backwards; they do not depend on ``dt``. Two errors a step
    move three coordinates, so that wheel noise alone has no density. ``skid``, which covers what the motion model
    misses (contacts), makes the covariance regular.

    Attributes:
        noise: of the wheels.
        track: between the wheels, m.
        skid: standard deviations a step: forward (m), left (m), turn (rad).
    """

    noise: DifferentialNoise
    track: Float[Array, ""] | float = 0.16
    skid: tuple[float, float, float] = (0.004, 0.004, 0.002)

    manifold = PLANAR
    controls = 2
    commanded = True

    def mean(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 2"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Drive the arc of the two wheels, heading in [-pi, pi; eq. M25)."""
        forward, left, turn = jnp.moveaxis(self._arc(control), -1, 0)
        c, s = jnp.cos(state[..., 2]), jnp.sin(state[..., 2])
        x, y = state[..., 0] + c * forward - s * left, state[..., 1] + s * forward + c * left
        return jnp.stack([x, y, wrap_angle(state[..., 2] + turn)], axis=-1)

    def expected(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 2"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """``E[z' | z, u]`` to first order: the arc of the expected travel of both wheels (eq. M25)."""
        return self.mean(state, self._moments(control)[0], dt)

    def noise_covariance(
        self, state: Float[Array, "3"], control: Float[Array, "2"], dt: float | Array
    ) -> Float[Array, "3 3"]:
        """``G Q G^T + skid`` in the body frame after the step, to first order in the errors of the wheels (eq. M26)."""
        control, stds = self._moments(control)
        turn = self._arc(control)[2]
        c, s = jnp.cos(turn), jnp.sin(turn)
        back = jnp.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        G = back @ jax.jacfwd(self._arc)(control) * stds
        return G @ G.T + jnp.diag(jnp.asarray(self.skid) ** 2)

    def sample(
        self, key: PRNGKeyArray, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 2"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Draw an executed step, then skid."""
        by_wheels, by_skid = jax.random.split(key)
        reached = self.executed(state, control, jax.random.normal(by_wheels, (*state.shape[:-1], 2)))
        return PLANAR.perturb(reached, jax.random.normal(by_skid, state.shape) * jnp.asarray(self.skid))

    def executed(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 2"], normal: Float[Array, "*batch 2"]
    ) -> Float[Array, "*batch 3"]:
        """Return the pose after the executed command (eq. M25).

        Args:
            state: ``(x, y, heading)`` before the step.
            control: travel of the left and the right wheel, m.
            normal: a standard normal for each wheel.

        Returns:
            ``(x, y, heading)`` after it.
        """
        rolled = jnp.sign(control) * jnp.maximum(0.0, jnp.abs(control) + self.noise.stds(control) * normal)
        return self.mean(state, rolled, 0.0)

    def _moments(self, control: Float[Array, "*batch 2"]) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch 2"]]:
        """Return the expected travel of each wheel and its standard deviation, m: noise never reverses a wheel."""
        travel = rectified(jnp.abs(control), self.noise.stds(control))
        return jnp.sign(control) * travel.mean, jnp.abs(jnp.sign(control)) * jnp.sqrt(travel.variance)

    def _arc(self, control: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
        left, right = control[..., 0], control[..., 1]
        return arc_of(0.5 * (left + right), (right - left) / self.track)
