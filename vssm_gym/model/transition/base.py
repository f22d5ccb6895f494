"""Define the interface of a transition ``p(z' | z, u)`` for filters, rollouts, planners and imagined environments."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.model.transition.belief import GaussianBelief, normal_log_prob
from vssm_gym.model.transition.manifold import Manifold

QUOTED_STEP = 0.1  # s, the step for which papers and defaults quote standard deviations; variances grow with time


class Transition(eqx.Module):
    """``p(z' | z, u)`` over ``dt`` seconds; its noise and geometry are fields.

    A transition implements :meth:`mean` and :meth:`noise_covariance`; the other methods follow to first order, and a
    subclass overrides those that it knows exactly. Subclasses are final. ``mean``, ``sample`` and ``log_prob`` take
    leading batch axes; the others take one state. Controls that are displacements do not depend on ``dt``.
    """

    manifold: eqx.AbstractClassVar[Manifold]  # the space of its states
    controls: eqx.AbstractClassVar[int]  # numbers in a control
    commanded: eqx.AbstractClassVar[bool]  # whether the control determines the motion: prediction needs no image

    @abc.abstractmethod
    def mean(self, state: Any, control: Float[Array, "*batch m"], dt: float | Array) -> Any:
        """Return the state after a step without noise.

        Args:
            state: before it, of the manifold; leading batch axes.
            control: of the step, in the units of the transition.
            dt: length of the step, s.

        Returns:
            The state, with the batch axes of ``state`` and ``control``.
        """

    def expected(self, state: Any, control: Float[Array, "*batch m"], dt: float | Array) -> Any:
        """``E[z' | z, u]`` to the order that the transition knows: :meth:`mean`, unless its noise moves the average.

        Args:
            state: before the step, of the manifold; leading batch axes.
            control: of the step, in the units of the transition.
            dt: length of the step, s.

        Returns:
            The state, with the batch axes of ``state`` and ``control``.
        """
        return self.mean(state, control, dt)

    @abc.abstractmethod
    def noise_covariance(self, state: Any, control: Float[Array, "m"], dt: float | Array) -> Float[Array, "n n"]:
        """Return the covariance of the errors ``xi`` about :meth:`expected` after a step from a known state.

        Args:
            state: before the step; one state.
            control: of the step.
            dt: length of the step, s.

        Returns:
            In the coordinates of the manifold (m, rad; the pose's in the body frame); positive definite in the pose.
        """

    def jacobian(self, state: Any, control: Float[Array, "m"], dt: float | Array) -> Float[Array, "n n"]:
        """``F = d error(E[z'], E[z' | perturb(z, xi)]) / d xi`` at zero: the propagation of errors over a step.

        Args:
            state: before the step; one state.
            control: of the step.
            dt: length of the step, s.

        Returns:
            F, from errors before the step to errors after it.
        """
        manifold, after = self.manifold, self.expected(state, control, dt)
        carried = lambda xi: manifold.error(after, self.expected(manifold.perturb(state, xi), control, dt))
        return jax.jacfwd(carried)(jnp.zeros(len(manifold.turns)))

    def predict(
        self,
        belief: GaussianBelief,
        control: Float[Array, "m"],
        dt: float | Array,
        noise_scale: Float[Array, "n"] | float = 1.0,
    ) -> GaussianBelief:
        """``int p(z' | z, u) q(z) dz`` to first order: ``N(E[z' | z], F P F^T + S Q S)`` (eqs. M19 and I3).

        Args:
            belief: over the state now.
            control: of the step.
            dt: its length, s.
            noise_scale: diagonal of S, by which the standard deviations of the noise are multiplied; 0 leaves it out.

        Returns:
            The belief over the state after the step.
        """
        F = self.jacobian(belief.mean, control, dt)
        scale = jnp.broadcast_to(jnp.asarray(noise_scale, F.dtype), F.shape[:1])
        Q = scale[:, None] * self.noise_covariance(belief.mean, control, dt) * scale
        covariance = F @ belief.covariance @ F.T + Q
        return GaussianBelief(self.expected(belief.mean, control, dt), 0.5 * (covariance + covariance.T), self.manifold)

    def sample(self, key: PRNGKeyArray, state: Any, control: Float[Array, "*batch m"], dt: float | Array) -> Any:
        """Draw ``z' ~ p(z' | z, u)``.

        Args:
            key: random key.
            state: before the step; leading batch axes.
            control: of the step, one for each state.
            dt: length of the step, s.

        Returns:
            One independent draw for each state of the batch.
        """
        covariance = self._every_covariance(state, control, dt)
        root = jnp.linalg.cholesky(covariance)
        xi = jnp.einsum("...ij,...j->...i", root, jax.random.normal(key, covariance.shape[:-1]))
        return self.manifold.perturb(self.expected(state, control, dt), xi)

    def log_prob(
        self, following: Any, state: Any, control: Float[Array, "*batch m"], dt: float | Array
    ) -> Float[Array, "*batch"]:
        """``log p(z' | z, u)`` of the Gaussian about :meth:`expected`.

        Args:
            following: ``z'``, the state after the step; leading batch axes.
            state: ``z``, before it.
            control: ``u``.
            dt: length of the step, s.

        Returns:
            Log densities with respect to the volume of the state space (m, rad), one for each state of the batch.
        """
        xi = self.manifold.error(self.expected(state, control, dt), following)
        return normal_log_prob(xi, self._every_covariance(state, control, dt)) - self.manifold.log_volume(xi)

    def belief_at(
        self,
        pose: Float[Array, "3"] | Float[Array, "4 4"] | np.ndarray,
        *,
        translation_std: float = 0.001,
        rotation_std: float = 0.001,
        velocity_std: float = 0.5,
        rate_std: float = 1.0,
    ) -> GaussianBelief:
        """Return the belief over a body near a pose, at rest on average.

        Args:
            pose: of the body in the world: ``(x, y, heading)`` in m and rad, or ``T_world_body`` ``(4, 4)``.
            translation_std: standard deviation along each axis of the body frame, m.
            rotation_std: standard deviation about each axis of the body frame, rad.
            velocity_std: standard deviation of each linear velocity, where the state has one, m/s.
            rate_std: standard deviation of each angular velocity, where the state has one, rad/s.

        Returns:
            A Gaussian on this transition's manifold.
        """
        T_world_body = jnp.asarray(pose, jnp.float32)
        if T_world_body.shape == (3,):
            T_world_body = planar_to_matrix(T_world_body)
        turns, p = self.manifold.turns, self.manifold.twists.shape[1]
        of_pose = np.where(turns[:p], rotation_std, translation_std)
        of_velocity = np.where(turns[p:], rate_std, velocity_std)
        variances = jnp.asarray(np.concatenate([of_pose, of_velocity]) ** 2, jnp.float32)
        return GaussianBelief(self.manifold.resting(T_world_body), jnp.diag(variances), self.manifold)

    def mean_path(self, state: Any, controls: Float[Array, "*batch time m"], dt: float | Array) -> Any:
        """Return the states after each of several controls without noise.

        Args:
            state: at which every sequence starts; one state.
            controls: one sequence, or a batch of them.
            dt: length of a step, s.

        Returns:
            The states, with axes ``(*batch, time, ...)``.
        """
        path = lambda controls: _path(lambda z, u: self.mean(z, u, dt), state, controls)
        for _ in range(controls.ndim - 2):
            path = jax.vmap(path)
        return path(controls)

    def sample_paths(self, key: PRNGKeyArray, states: Any, controls: Float[Array, "time m"], dt: float | Array) -> Any:
        """Draw ``z_1..z_T ~ prod_t p(z_t | z_t-1, u_t)`` from each state of a batch.

        Args:
            key: random key.
            states: ``(batch, ...)``, at which the paths start.
            controls: one sequence for all.
            dt: length of a step, s.

        Returns:
            The states after each control, with axes ``(batch, time, ...)``.
        """
        batch = jax.tree.leaves(states)[0].shape[0]
        repeated = jnp.broadcast_to(controls[:, None], (len(controls), batch, *controls.shape[1:]))
        step = lambda z, now: self.sample(now[0], z, now[1], dt)
        paths = _path(step, states, (jax.random.split(key, len(controls)), repeated))
        return jax.tree.map(lambda a: jnp.swapaxes(a, 0, 1), paths)

    def _every_covariance(self, state: Any, control: Float[Array, "*batch m"], dt: float | Array) -> Array:
        """Return :meth:`noise_covariance` of each state of a batch."""
        one = lambda state, control: self.noise_covariance(state, control, dt)
        for _ in range(control.ndim - 1):
            one = jax.vmap(one)
        return one(state, control)


def _path(step: Callable[[Any, Any], Any], state: Any, inputs: Any) -> Any:
    """Return ``z_t = step(z_t-1, input_t)`` for every t, along the leading axis."""

    def advance(state, now):
        state = step(state, now)
        return state, state

    return jax.lax.scan(advance, state, inputs)[1]
