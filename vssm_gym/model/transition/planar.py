"""Model a planar holonomic robot: ``p(z' | z, u)`` of ``(x, y, heading)`` (TNP-SM).

Control ``u = (turn, o, s)`` a step, rad, rad, m: ``heading' = heading + sign(turn) max(0, |turn| + e_a)``,
``xy' = xy + [cos phi, sin phi] max(0, s + e_s)``, ``phi = heading + o + e_a``; ``e_a`` acts on the heading only where
the robot turns, and no noise acts on a robot that does not try to move. :meth:`Planar.executed` implements this noise;
the simulator has a NumPy twin of it, which a test compares with this one.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.rectified import rectified


class MotionNoise(eqx.Module):
    """Hold standard deviations of a control step's execution, as the robot believes them.

    Attributes:
        turn: of the direction of travel, and of the heading where the robot turns, rad.
        step: of the distance travelled, m.
    """

    turn: Float[Array, "*batch"] | float  # sigma_a
    step: Float[Array, "*batch"] | float  # sigma_s


class Planar(Transition):
    """Model a holonomic robot on a floor, which turns and then drives in any direction.

    States are ``(x, y, heading)`` of the body in the world, m and rad. Controls are ``(turn, o, s)`` of a step: change
    of heading (rad), direction of travel relative to the heading before (rad), distance (m); they do not depend on
    ``dt``. Two errors a step move three coordinates, so that execution noise alone has no density. ``slip``, which
    covers what the motion model misses (contacts), makes the covariance regular.

    Attributes:
        noise: of the execution.
        slip: standard deviations a step: forward (m), left (m), turn (rad).
    """

    noise: MotionNoise
    slip: tuple[float, float, float] = (0.004, 0.004, 0.002)

    manifold = PLANAR
    controls = 3
    commanded = True

    def mean(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Drive ``s`` along ``heading + o``, and turn (eq. M23)."""
        turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
        phi = state[..., 2] + offset
        x, y = state[..., 0] + step * jnp.cos(phi), state[..., 1] + step * jnp.sin(phi)
        return jnp.stack([x, y, wrap_angle(state[..., 2] + turn)], axis=-1)

    def expected(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """``E[z' | z, u]``: noise lengthens short motions, which it never reverses, and bends long ones (eq. M23)."""
        return self.mean(state, self._moments(control)[0], dt)

    def jacobian(self, state: Float[Array, "3"], control: Float[Array, "3"], dt: float | Array) -> Float[Array, "3 3"]:
        """``xi' = Ad(exp(u)^-1) xi`` with the expected control ``u``: the old error in the new body frame."""
        turn, offset, step = self._moments(control)[0]
        c, s = jnp.cos(turn), jnp.sin(turn)
        dx, dy = step * jnp.cos(offset), step * jnp.sin(offset)
        return jnp.array([[c, s, c * -dy + s * dx], [-s, c, s * dy + c * dx], [0.0, 0.0, 1.0]])

    def noise_covariance(
        self, state: Float[Array, "3"], control: Float[Array, "3"], dt: float | Array
    ) -> Float[Array, "3 3"]:
        """Return the covariance of execution noise and slip in the body frame after the step (eq. M23).

        ``e_a`` moves both heading and direction, so that the two are correlated: positively where the robot turns left,
        negatively where it turns right.
        """
        (turn, offset, _), covariance = self._moments(control)
        c, s = jnp.cos(offset - turn), jnp.sin(offset - turn)
        axes = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # along and across the motion, and the turn
        return axes @ covariance @ axes.T + jnp.diag(jnp.asarray(self.slip) ** 2)

    def _moments(
        self, control: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Return the expected control, and the covariance of (displacement along and across it, turn)."""
        turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
        turned, moved = rectified(jnp.abs(turn), self.noise.turn), rectified(step, self.noise.step)
        turns, drives = jnp.abs(jnp.sign(turn)), jnp.where(step > 0.0, 1.0, 0.0)
        # Moments of the direction's error: E[cos e] = k, E[cos^2 e] = (1 + k^4) / 2, E[e sin e] = k sigma^2
        k = jnp.exp(-0.5 * jnp.asarray(self.noise.turn) ** 2)
        square = moved.variance + moved.mean**2
        along = jnp.maximum(0.5 * square * (1.0 + k**4) - (k * moved.mean) ** 2, 0.0)
        across = 0.5 * square * (1.0 - k**4)
        both = jnp.sign(turn) * drives * k * moved.mean * turned.with_noise
        zero = jnp.zeros_like(both)
        rows = [[drives * along, zero, zero], [zero, drives * across, both], [zero, both, turns * turned.variance]]
        covariance = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
        return jnp.stack([jnp.sign(turn) * turned.mean, offset, drives * k * moved.mean], axis=-1), covariance

    def sample(
        self, key: PRNGKeyArray, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Draw an executed step, then slip."""
        by_execution, by_slip = jax.random.split(key)
        normal = jnp.moveaxis(jax.random.normal(by_execution, (2, *state.shape[:-1])), 0, -1)
        reached = self.executed(state, control, normal)
        return PLANAR.perturb(reached, jax.random.normal(by_slip, state.shape) * jnp.asarray(self.slip))

    def executed(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], normal: Float[Array, "*batch 2"]
    ) -> Float[Array, "*batch 3"]:
        """Return the pose after the executed command (eq. M23).

        Noise acts only where the robot tries to move, and never reverses a motion.

        Args:
            state: ``(x, y, heading)`` before the step.
            control: ``(turn, o, s)``.
            normal: standard normals for the direction and for the distance.

        Returns:
            ``(x, y, heading)`` after it.
        """
        turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
        e_a, e_s = normal[..., 0] * self.noise.turn, normal[..., 1] * self.noise.step
        turned = jnp.sign(turn) * jnp.maximum(0.0, jnp.abs(turn) + e_a)
        moved = jnp.where(step > 0.0, jnp.maximum(0.0, step + e_s), 0.0)
        return self.mean(state, jnp.stack([turned, offset + e_a, moved], axis=-1), 0.0)


def planar_belief(planar: Float[Array, "3"], covariance: Float[Array, "3 3"]) -> GaussianBelief:
    """``N(planar, covariance)`` over ``(x, y, heading)``, the covariance of (forward, left, turn) in the body frame."""
    return GaussianBelief(planar, covariance, PLANAR)


def world_covariance(belief: GaussianBelief) -> Float[Array, "3 3"]:
    """Return the covariance of ``(x, y, heading)`` in world axes of a planar belief."""
    c, s = jnp.cos(belief.mean[2]), jnp.sin(belief.mean[2])
    R = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return R @ belief.covariance @ R.T
