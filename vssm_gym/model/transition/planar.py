"""Model a planar holonomic robot: ``p(z' | z, u)`` of ``(x, y, heading)`` (TNP-SM).

Control ``u = (turn, o, s)`` a step, rad, rad, m: ``heading' = heading + turn``, ``xy' = xy + [cos phi, sin phi] s``,
``phi = heading + o``, or ``phi = o`` of a robot whose directions are those of the world. Its noise replaces the
control by another one (:class:`~vssm_gym.model.transition.motion_noise.MotionNoise`,
:class:`~vssm_gym.model.transition.biased_noise.BiasedNoise`); a robot that does not try to move stays where it is.
:meth:`Planar.executed` implements this noise; the simulator has NumPy twins of it, which tests compare with it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.axes import DirectionFrame
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.biased_noise import BiasedNoise
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.motion_noise import MotionNoise


class Planar(Transition):
    """Model a holonomic robot on a floor, which turns and then drives in any direction.

    States are ``(x, y, heading)`` of the body in the world, m and rad. Controls are ``(turn, o, s)`` of a step: change
    of heading (rad), direction of travel (rad), distance (m); they do not depend on ``dt``. The direction is relative
    to the heading before the step, or to the world's x axis. Two errors a step move three coordinates, so that
    execution noise alone has no density. ``slip``, which covers what the motion model misses (contacts), makes the
    covariance regular.

    Attributes:
        noise: of the execution.
        slip: standard deviations a step: forward (m), left (m), turn (rad).
        direction_frame: of a control's direction. With ``world`` the robot has a compass: where it drives to does not
            depend on its heading.
    """

    noise: MotionNoise | BiasedNoise
    slip: tuple[float, float, float] = (0.004, 0.004, 0.002)
    direction_frame: DirectionFrame = eqx.field(static=True, default="body")

    manifold = PLANAR
    controls = 3
    commanded = True

    def mean(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Drive ``s`` along ``heading + o``, or along ``o`` in the world, and turn (eq. M23)."""
        return _moved(state, self._in_body(state, control, control))

    def expected(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """``E[z' | z, u]``: noise lengthens short motions, bends long ones, and may have a mean (eq. M23)."""
        return _moved(state, self._moments(state, control)[0])

    def jacobian(self, state: Float[Array, "3"], control: Float[Array, "3"], dt: float | Array) -> Float[Array, "3 3"]:
        """``xi' = Ad(exp(u)^-1) xi`` with the expected control ``u``: the old error in the new body frame.

        With directions in the world, an error of the heading does not move the place that the robot drives to.
        """
        turn, offset, step = self._moments(state, control)[0]
        c, s = jnp.cos(turn), jnp.sin(turn)
        dx, dy = step * jnp.cos(offset), step * jnp.sin(offset)
        if self.direction_frame == "world":
            dx, dy = (jnp.where(control[2] > 0.0, 0.0, d) for d in (dx, dy))
        return jnp.array([[c, s, c * -dy + s * dx], [-s, c, s * dy + c * dx], [0.0, 0.0, 1.0]])

    def noise_covariance(
        self, state: Float[Array, "3"], control: Float[Array, "3"], dt: float | Array
    ) -> Float[Array, "3 3"]:
        """Return the covariance of execution noise and slip in the body frame after the step (eq. M23).

        ``e_a`` of eq. M23 moves both heading and direction, so that the two are correlated: positively where the robot
        turns left, negatively where it turns right.
        """
        (turn, offset, _), covariance = self._moments(state, control)
        c, s = jnp.cos(offset - turn), jnp.sin(offset - turn)
        axes = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # along and across the motion, and the turn
        return axes @ covariance @ axes.T + jnp.diag(jnp.asarray(self.slip) ** 2)

    def _moments(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch 3 3"]]:
        """Return the expected control in the body frame, and the covariance of (along and across it, turn)."""
        expected, covariance = self.noise.moments(control)
        return self._in_body(state, control, expected), covariance

    def _in_body(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], moved: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch 3"]:
        """Return ``moved``, what noise made of ``control``, with its direction relative to the heading.

        What a turn on the spot shifts is relative to the heading in either frame.
        """
        if self.direction_frame == "body":
            return moved
        heading = jnp.where(control[..., 2] > 0.0, state[..., 2], 0.0)
        parts = jnp.broadcast_arrays(moved[..., 0], moved[..., 1] - heading, moved[..., 2])
        return jnp.stack(parts, axis=-1)

    def sample(
        self, key: PRNGKeyArray, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Draw an executed step, then slip."""
        by_execution, by_slip = jax.random.split(key)
        normal = jnp.moveaxis(jax.random.normal(by_execution, (self.noise.normals, *state.shape[:-1])), 0, -1)
        reached = self.executed(state, control, normal)
        return PLANAR.perturb(reached, jax.random.normal(by_slip, state.shape) * jnp.asarray(self.slip))

    def executed(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"], normal: Float[Array, "*batch n"]
    ) -> Float[Array, "*batch 3"]:
        """Return the pose after the executed command (eq. M23).

        Noise acts only where the robot tries to move, and never reverses a motion.

        Args:
            state: ``(x, y, heading)`` before the step.
            control: ``(turn, o, s)``.
            normal: as many standard normals as the noise needs: of MotionNoise for the direction and for the distance.

        Returns:
            ``(x, y, heading)`` after it.
        """
        return _moved(state, self._in_body(state, control, self.noise.executed(control, normal)))


def _moved(state: Float[Array, "*batch 3"], control: Float[Array, "*batch 3"]) -> Float[Array, "*batch 3"]:
    """Return the pose after exactly this control, with its direction relative to the heading."""
    turn, offset, step = control[..., 0], control[..., 1], control[..., 2]
    phi = state[..., 2] + offset
    x, y = state[..., 0] + step * jnp.cos(phi), state[..., 1] + step * jnp.sin(phi)
    return jnp.stack([x, y, wrap_angle(state[..., 2] + turn)], axis=-1)


def planar_belief(planar: Float[Array, "3"], covariance: Float[Array, "3 3"]) -> GaussianBelief:
    """``N(planar, covariance)`` over ``(x, y, heading)``, the covariance of (forward, left, turn) in the body frame."""
    return GaussianBelief(planar, covariance, PLANAR)


def world_covariance(belief: GaussianBelief) -> Float[Array, "3 3"]:
    """Return the covariance of ``(x, y, heading)`` in world axes of a planar belief."""
    c, s = jnp.cos(belief.mean[2]), jnp.sin(belief.mean[2])
    R = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return R @ belief.covariance @ R.T
