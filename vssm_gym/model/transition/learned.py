"""Model a body by a nominal step and what a network has learned about it (VSSM-LM).

    x = (body axes of z, u, rest),    (m, r, s) = network(x),    h = dt / step
    body' = perturb(f(body, u), A (h m + sqrt(h) s_body e)),    rest' = rest + h (r - rest) + sqrt(h) s_rest e

``f`` is the mean of the nominal transition (the integration of an IMU, a robot's kinematics), ``A`` turns errors in
body axes to those of the manifold at the nominal prediction, and ``e ~ N(0, 1)``. The spread ``s`` depends on ``x``:
noise is heteroscedastic. The network reads no place and no yaw (:mod:`vssm_gym.model.transition.body_axes`), so that
``p(z' | z, u)`` commutes with every motion of the world that keeps gravity. The rest is formed wholly by the network.

Several networks, each trained without another part of the data, may correct together, each with a rest of its own:

    m = sum_k w_k m_k,   w_k = 1/K + d (b_k - mean b) / sqrt(K),   s_body^2 = mean_k s_k^2,   b' = b,   b_0 ~ N(0, 1)

With ``d = 1``, ``w`` has the mean and the covariance of the choice of one of them at random. It hardly changes within a
path: where networks disagree, futures diverge steadily, as errors of a model do, and not as noise of single steps.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.residual_network import ResidualNetwork, new_network
from vssm_gym.model.transition.with_rest import RestState, WithRest

REST = 8  # dimensions of the latent rest (VSSM-LM)
HIDDEN, RESIDUAL_LAYERS = 64, 5  # of the hidden layers, and how many of them (VSSM-LM)
CORRECTION_PER_STD = 0.1  # corrections are a small part of what a state changes in a step, in these units they learn
# Bounds of noise, in the units of its scale: where a network has seen no data, it is neither sure nor lost
SMALLEST_STD, SMALLEST_REST_STD, LARGEST_LOG_STD = 0.05, 1e-3, 3.0
LARGEST_INPUT = 6.0  # standard deviations; inputs beyond it are clipped, where the network knows nothing


class Scales(eqx.Module):
    """Hold the units in which a network sees and says numbers; they are measured on data and not trained.

    Attributes:
        centre: mean of the inputs ``(body axes, control)``.
        spread: their standard deviations.
        errors: of a nominal step, in the coordinates of the body's manifold.
        step: s, the step for which the network was trained.
    """

    centre: Float[Array, "inputs"]
    spread: Float[Array, "inputs"]
    errors: Float[Array, "n"]
    step: Float[Array, ""]


class Step(NamedTuple):
    """Hold what is known about a step from a state."""

    mean: RestState  # without noise
    stds: Float[Array, "*batch n"]  # of the errors in body axes, then of the rest


class LearnedTransition(Transition):
    """Correct a nominal transition by a network that was trained on recorded motion.

    States are :class:`RestState`: that of the nominal transition, and a latent rest, zero where nothing is known of it.
    Controls begin with those of the nominal transition; what follows them is read by the network alone.

    Attributes:
        nominal: the step that is corrected; its noise is not used.
        network: of the inputs to correction, rest and log standard deviations; several have a leading axis.
        scales: units of the network's inputs and outputs.
        size: dimensions of the rest of a network.
        further: controls beyond those of the nominal transition.
        members: number of networks; one has no leading axis, and no weight.
        disagreement: ``d``, by which the spread of the weights is multiplied; None: one network.
    """

    nominal: Transition
    network: ResidualNetwork
    scales: Scales
    size: int = eqx.field(static=True, default=REST)
    further: int = eqx.field(static=True, default=0)
    members: int = eqx.field(static=True, default=1)
    disagreement: Float[Array, ""] | None = None

    @property
    def rest(self) -> int:
        """Return the dimensions of the whole rest: that of each network, then what decides on their weights."""
        return self.size if self.members == 1 else self.members * (self.size + 1)

    @property
    def manifold(self) -> WithRest:  # type: ignore[override]
        """Return the space of the nominal transition's states, extended by the rest."""
        return WithRest(self.nominal.manifold, self.rest)

    @property
    def controls(self) -> int:  # type: ignore[override]
        """Return the number of controls: the nominal transition's, and the further ones."""
        return self.nominal.controls + self.further

    @property
    def commanded(self) -> bool:  # type: ignore[override]
        """Return whether the nominal transition is commanded."""
        return self.nominal.commanded

    def step(self, state: RestState, control: Float[Array, "*batch m"], dt: float | Array) -> Step:
        """Return mean and spread of ``p(z' | z, u)`` by one evaluation of the network (eq. M33).

        Args:
            state: before the step; leading batch axes.
            control: of the step, one for each state.
            dt: length of the step, s.
        """
        axes, n, size = body_axes(self.nominal.manifold), len(self.nominal.manifold.turns), self.size
        seen = jnp.concatenate([axes.describe(state.body), control], axis=-1)
        seen = jnp.clip((seen - self.scales.centre) / self.scales.spread, -LARGEST_INPUT, LARGEST_INPUT)
        h = dt / self.scales.step
        least = jnp.log(jnp.concatenate([jnp.full(n, SMALLEST_STD), jnp.full(size, SMALLEST_REST_STD)]))
        stds_of = lambda said: jnp.exp(jnp.clip(said[..., n + size :], least, LARGEST_LOG_STD))
        if self.members == 1:
            said = self.network(jnp.concatenate([seen, state.rest], axis=-1))
            correction, stds = said[..., :n], stds_of(said)
            of_body, of_rest, to = stds[..., :n], stds[..., n:], said[..., n : n + size]
        else:
            said = self._of_members(seen, state.rest)
            weights, stds = self._weights(state.rest), stds_of(said)
            correction = jnp.sum(weights[..., None] * said[..., :n], axis=-2)
            of_body = jnp.sqrt(jnp.mean(stds[..., :n] ** 2, axis=-2))
            flat = lambda a: a.reshape(*a.shape[:-2], -1)
            kept = jnp.full((*said.shape[:-2], self.members), SMALLEST_REST_STD)
            of_rest = jnp.concatenate([flat(stds[..., n:]), kept], axis=-1)
            to = jnp.concatenate([flat(said[..., n : n + size]), state.rest[..., self.members * size :]], axis=-1)
        after = self.nominal.mean(state.body, control[..., : self.nominal.controls], dt)
        xi = axes.to_errors(after, h * correction * CORRECTION_PER_STD * self.scales.errors)
        body = self.nominal.manifold.perturb(after, xi)
        rest = state.rest + h * (to - state.rest)
        stds = jnp.concatenate([of_body * self.scales.errors, of_rest], axis=-1)
        return Step(RestState(body, rest), stds * jnp.sqrt(h))

    def mean(self, state: RestState, control: Float[Array, "*batch m"], dt: float | Array) -> RestState:
        """Take the nominal step and correct it (eq. M33)."""
        return self.step(state, control, dt).mean

    def noise_covariance(self, state: RestState, control: Float[Array, "m"], dt: float | Array) -> Float[Array, "n n"]:
        """``A diag(s^2) A^T``: independent in body axes, with velocities turned to the world's."""
        step = self.step(state, control, dt)
        n = len(self.nominal.manifold.turns)
        axes = body_axes(self.nominal.manifold)
        turned = jax.vmap(lambda column: axes.to_errors(step.mean.body, column), out_axes=1)(jnp.eye(n))
        A = jax.scipy.linalg.block_diag(turned, jnp.eye(self.rest))
        return (A * step.stds**2) @ A.T

    def sample(
        self, key: PRNGKeyArray, state: RestState, control: Float[Array, "*batch m"], dt: float | Array
    ) -> RestState:
        """Draw an error in body axes, and turn it to the manifold's."""
        step = self.step(state, control, dt)
        e = step.stds * jax.random.normal(key, step.stds.shape)
        return self.perturb_in_body_axes(step.mean, e)

    def perturb_in_body_axes(self, state: RestState, e: Float[Array, "*batch n"]) -> RestState:
        """Return the state an error away whose velocities are in body axes.

        Args:
            state: of the manifold; leading batch axes.
            e: errors of the pose (m, rad) and of the velocities (m/s, rad/s), both in body axes, then of the rest.
        """
        n = len(self.nominal.manifold.turns)
        xi = body_axes(self.nominal.manifold).to_errors(state.body, e[..., :n])
        return self.manifold.perturb(state, jnp.concatenate([xi, e[..., n:]], axis=-1))

    def error_in_body_axes(self, mean: RestState, state: RestState) -> Float[Array, "*batch n"]:
        """Return ``e`` with ``perturb_in_body_axes(mean, e) = state``."""
        n = len(self.nominal.manifold.turns)
        xi = self.manifold.error(mean, state)
        of_body = body_axes(self.nominal.manifold).from_errors(mean.body, xi[..., :n])
        return jnp.concatenate([of_body, xi[..., n:]], axis=-1)

    def belief_at(
        self,
        pose: Float[Array, "3"] | Float[Array, "4 4"] | np.ndarray,
        *,
        translation_std: float = 0.001,
        rotation_std: float = 0.001,
        velocity_std: float = 0.5,
        rate_std: float = 1.0,
    ) -> GaussianBelief:
        """Return the nominal transition's belief near a pose, with the rest at its prior ``N(0, 1)``.

        Args:
            pose: of the body in the world: ``(x, y, heading)`` in m and rad, or ``T_world_body`` ``(4, 4)``.
            translation_std: standard deviation along each axis of the body frame, m.
            rotation_std: standard deviation about each axis of the body frame, rad.
            velocity_std: standard deviation of each linear velocity, where the state has one, m/s.
            rate_std: standard deviation of each angular velocity, where the state has one, rad/s.

        Returns:
            A Gaussian on this transition's manifold.
        """
        of_body = self.nominal.belief_at(
            pose,
            translation_std=translation_std,
            rotation_std=rotation_std,
            velocity_std=velocity_std,
            rate_std=rate_std,
        )
        return self.extend(of_body)

    def extend(self, of_body: GaussianBelief) -> GaussianBelief:
        """Return a belief over body and rest of one over the body: the rest is at its prior ``N(0, 1)``."""
        covariance = jax.scipy.linalg.block_diag(of_body.covariance, jnp.eye(self.rest))
        return GaussianBelief(RestState(of_body.mean, jnp.zeros(self.rest)), covariance, self.manifold)

    def start(self, body: Any) -> RestState:
        """Return states of the nominal transition, (*batch, ...), with the rest at zero."""
        batch = self.nominal.manifold.pose(body).shape[:-2]
        return RestState(body, jnp.zeros((*batch, self.rest)))

    def _of_members(self, seen: Float[Array, "*batch inputs"], rest: Float[Array, "*batch r"]) -> Array:
        """Return what each network says of the same step and its own rest, axes ``(*batch, members, outputs)``."""
        rests = rest[..., : self.members * self.size].reshape(*rest.shape[:-1], self.members, self.size)
        shared = jnp.broadcast_to(seen[..., None, :], (*rests.shape[:-1], seen.shape[-1]))
        inputs = jnp.concatenate([shared, rests], axis=-1)
        return jax.vmap(lambda network, x: network(x), in_axes=(0, -2), out_axes=-2)(self.network, inputs)

    def _weights(self, rest: Float[Array, "*batch r"]) -> Float[Array, "*batch members"]:
        """``w_k = 1/K + d (b_k - mean b) / sqrt(K)``: their sum is one."""
        b = rest[..., self.members * self.size :]
        spread = jnp.asarray(self.disagreement) / self.members**0.5
        return 1.0 / self.members + spread * (b - b.mean(axis=-1, keepdims=True))


def together(members: list[LearnedTransition]) -> LearnedTransition:
    """Return one transition in which the networks of several correct the same nominal step together.

    Args:
        members: each with one network; they differ in nothing else.
    """
    if len(members) == 1:
        return members[0]
    first = members[0]
    networks = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(member.network for member in members))
    return LearnedTransition(
        first.nominal, networks, first.scales, first.size, first.further, len(members), jnp.ones(())
    )


def untrained(
    key: PRNGKeyArray,
    nominal: Transition,
    scales: Scales,
    size: int = REST,
    further: int = 0,
    width: int = HIDDEN,
    depth: int = RESIDUAL_LAYERS,
) -> LearnedTransition:
    """Return the nominal transition with a network that corrects nothing yet.

    Args:
        key: random key of the hidden weights.
        nominal: the step that will be corrected; its states are of PLANAR or RIGID.
        scales: units of inputs and outputs.
        size: dimensions of the rest.
        further: controls beyond those of the nominal transition.
        width: of the network's hidden layers.
        depth: number of its residual layers.
    """
    n = len(nominal.manifold.turns)
    inputs = body_axes(nominal.manifold).features + nominal.controls + further + size
    network = new_network(key, inputs, 2 * (n + size), width, depth)
    # The rest decays within ten steps at first, with little noise: what the network makes of it is learned.
    linear = network.linear.at[inputs - size :, n : n + size].set(0.9 * jnp.eye(size))
    offset = network.offset.at[2 * n + size :].set(jnp.log(0.1))
    network = eqx.tree_at(lambda net: (net.linear, net.offset), network, (linear, offset))
    return LearnedTransition(nominal, network, scales, size, further)
