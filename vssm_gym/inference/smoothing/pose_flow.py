"""Represent ``q(z)`` of one pose in SE(3) by a normalising flow: rotation first, then the position given it (eq. I64).

    R = R_0 chart(L f(eps_R) + l),    t = t_0 + R_0 (a + A vec(R_0^T R)) + R B g(eps_t; R_0^T R),    eps ~ N(0, 1)
    log q(z) = log N(eps) - log |df| - log |L| - log |chart| - log |dg| - log |B|

``f`` and ``g`` are layers of :mod:`coupling`, the chart makes a standard normal the uniform distribution of rotations,
and ``L`` and ``B`` are lower triangular. What a camera sees fixes its position where its rotation is known, seldom the
reverse. In this order all poses around a ball, rotation and position alike, are a mean that is linear in the rotation;
a flow that drew the position first would have to wrap R^3 around a hole. ``q`` starts as any Gaussian of the position
with the rotation unknown, and a narrow ``L`` makes it Gaussian in the tangent.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import inverse
from vssm_gym.inference.smoothing.coupling import Couplings
from vssm_gym.inference.smoothing.families import Draws, Marginals
from vssm_gym.inference.smoothing.rotation_chart import from_rotation, log_volume, to_rotation
from vssm_gym.model.transition.manifold import POSES

MOMENT_DRAWS = 4096  # from which entropy and covariance are estimated: 0.02 nats of standard error or so


class PoseDraws(NamedTuple):
    """Hold poses and their log density, nats with respect to m^3 rad^3."""

    poses: Float[Array, "samples 4 4"]
    log_prob: Float[Array, "samples"]


class PoseFlow(eqx.Module):
    """Represent a belief over ``T_world_body`` that need not be Gaussian nor have one mode.

    It is a :class:`~vssm_gym.model.transition.belief.Belief` over poses (4, 4), and the family of a trajectory of one
    step. All but the nominal pose is free.

    Attributes:
        nominal: ``T_world_body`` about which rotations and positions are stated, m.
        turn: ``l``, of the rotation in the chart.
        turn_scale: ``L`` with the logarithms of its diagonal; what lies above is not read.
        place: ``a``, m.
        place_by_rotation: ``A``, m, by the nine entries of the rotation, row by row.
        place_scale: ``B`` in body axes, m, stored as ``L`` is.
        rotation_layers: ``f``.
        position_layers: ``g``, with the rotation's entries as context.
    """

    nominal: Float[Array, "4 4"]
    turn: Float[Array, "3"]
    turn_scale: Float[Array, "3 3"]
    place: Float[Array, "3"]
    place_by_rotation: Float[Array, "3 9"]
    place_scale: Float[Array, "3 3"]
    rotation_layers: Couplings
    position_layers: Couplings

    @classmethod
    def around(
        cls, key: PRNGKeyArray, T_world_body: Float[Array, "4 4"], std: float | Array, turn_std: float | Array = 1.0
    ) -> "PoseFlow":
        """Return the member with a Gaussian position about a pose, and a rotation about it or wholly unknown.

        Args:
            key: of the networks, which do nothing until they are trained.
            T_world_body: the pose, m.
            std: standard deviation of each coordinate of the position, m.
            turn_std: of the rotation in the chart: 1 for the uniform distribution, less for one about the pose.
        """
        of_rotation, of_position = jax.random.split(key)
        scale = lambda value: jnp.diag(jnp.full(3, jnp.log(value)))
        return cls(
            nominal=jnp.asarray(T_world_body, jnp.float32),
            turn=jnp.zeros(3),
            turn_scale=scale(turn_std),
            place=jnp.zeros(3),
            place_by_rotation=jnp.zeros((3, 9)),
            place_scale=scale(std),
            rotation_layers=Couplings.of(of_rotation, 3, 0),
            position_layers=Couplings.of(of_position, 3, 9),
        )

    @property
    def mean(self) -> Float[Array, "4 4"]:
        """Return a central pose: that of the base's mean."""
        return self._push(jnp.zeros(6))[0]

    def sample(self, key: PRNGKeyArray, samples: int) -> Float[Array, "samples 4 4"]:
        """Draw poses ``T ~ q``, differentiably in all parameters."""
        return self.sample_with_log_prob(key, samples).poses

    def sample_with_log_prob(self, key: PRNGKeyArray, samples: int) -> PoseDraws:
        """Draw poses and state their density without inverting the flow."""
        eps = jax.random.normal(key, (samples, 6))
        poses, log_det = jax.vmap(self._push)(eps)
        return PoseDraws(poses, _standard_normal(eps) - log_det)

    def log_prob(self, state: Float[Array, "*batch 4 4"]) -> Float[Array, "*batch"]:
        """``log q(T)``, nats with respect to m^3 rad^3, the volume that Gaussian beliefs have."""
        flat = state.reshape(-1, 4, 4)
        eps, log_det = jax.vmap(self._pull)(flat)
        return (_standard_normal(eps) - log_det).reshape(state.shape[:-2])

    def entropy(self) -> Float[Array, ""]:
        """``-E_q[log q]``, nats, from draws of one key: an estimate, the same at every call."""
        return -jnp.mean(self.sample_with_log_prob(jax.random.key(0), MOMENT_DRAWS).log_prob)

    def draw(self, key: PRNGKeyArray, samples: int) -> Draws:
        """Draw trajectories of one step; see :class:`~vssm_gym.inference.smoothing.families.TrajectoryBelief`."""
        drawn = self.sample_with_log_prob(key, samples)
        return Draws(drawn.poses[:, None], -drawn.log_prob[:, None])

    def marginals(self) -> Marginals:
        """Return the central pose, and the second moment of draws about it."""
        mean = self.mean
        xi = POSES.error(mean, self.sample(jax.random.key(0), MOMENT_DRAWS))
        return Marginals(mean[None], (xi.T @ xi / len(xi))[None])

    def _push(self, eps: Float[Array, "6"]) -> tuple[Float[Array, "4 4"], Float[Array, ""]]:
        """Return the pose of a point of the base, and ``log |dT / d eps|``."""
        bent, of_rotation = self.rotation_layers.forward(eps[:3], jnp.zeros(0))
        w = _triangular(self.turn_scale) @ bent + self.turn
        R = to_rotation(w)
        y, of_position = self.position_layers.forward(eps[3:], R.reshape(-1))
        t = self._place(R) + R @ (_triangular(self.place_scale) @ y)
        T = jnp.zeros((4, 4)).at[:3, :3].set(R).at[:3, 3].set(t).at[3, 3].set(1.0)
        log_det = of_rotation + of_position + log_volume(w) + jnp.trace(self.turn_scale) + jnp.trace(self.place_scale)
        return jax.lax.stop_gradient(self.nominal) @ T, log_det

    def _pull(self, T_world_body: Float[Array, "4 4"]) -> tuple[Float[Array, "6"], Float[Array, ""]]:
        """Return the point of the base that a pose belongs to, and ``log |dT / d eps|`` there."""
        T = inverse(jax.lax.stop_gradient(self.nominal)) @ T_world_body
        R = T[:3, :3]
        w = from_rotation(R)
        bent = _solve(self.turn_scale, w - self.turn)
        y = _solve(self.place_scale, R.T @ (T[:3, 3] - self._place(R)))
        eps_rotation, of_rotation = self.rotation_layers.inverse(bent, jnp.zeros(0))
        eps_position, of_position = self.position_layers.inverse(y, R.reshape(-1))
        log_det = of_rotation + of_position + log_volume(w) + jnp.trace(self.turn_scale) + jnp.trace(self.place_scale)
        return jnp.concatenate([eps_rotation, eps_position]), log_det

    def _place(self, R: Float[Array, "3 3"]) -> Float[Array, "3"]:
        return self.place + self.place_by_rotation @ R.reshape(-1)


def _triangular(stored: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Return the lower triangular matrix whose diagonal is stored by its logarithms."""
    return jnp.tril(stored, -1) + jnp.diag(jnp.exp(jnp.diag(stored)))


def _solve(stored: Float[Array, "3 3"], right: Float[Array, "3"]) -> Float[Array, "3"]:
    return jax.scipy.linalg.solve_triangular(_triangular(stored), right, lower=True)


def _standard_normal(eps: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    return -0.5 * jnp.sum(eps**2, axis=-1) - 0.5 * eps.shape[-1] * jnp.log(2.0 * jnp.pi)
