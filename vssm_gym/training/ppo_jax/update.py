"""Compute PPO's advantages and improve the networks on a record (Schulman et al., 2016, 2017).

    delta_t = r_t + gamma (1 - terminated_t) V(x_t+1) - V(x_t)
    A_t = delta_t + gamma lambda (1 - ended_t) A_t+1
    loss = -E[min(rho A, clip(rho, 1 - c, 1 + c) A)] + c_v E[(A + V_old - V)^2] - c_e H

``rho`` is the ratio of densities of an action under the present and the acting policy. The value after a truncated
episode's last step is that of what was seen then. Steps that begin an episode are in no expectation.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from vssm_gym.training.config import PPOSettings
from vssm_gym.training.ppo_jax.network import ActorCritic
from vssm_gym.training.ppo_jax.rollout import Record

ADAM_EPSILON = 1e-5  # added to the root of the second moment, as is usual for PPO
LEAST_DEVIATION = 1e-8  # of the advantages of a batch, added before it divides


class Batch(eqx.Module):
    """Hold transitions of an update."""

    inputs: Float[Array, "n inputs"]
    action: Float[Array, "n a"]
    log_density: Float[Array, "n"]
    advantage: Float[Array, "n"]
    target: Float[Array, "n"]  # of the value
    weight: Float[Array, "n"]  # 1; 0 where an episode began


class Statistics(eqx.Module):
    """Hold means over the batches of an update, for the log."""

    policy_loss: Float[Array, ""]
    value_loss: Float[Array, ""]
    entropy: Float[Array, ""]
    divergence: Float[Array, ""]  # of the acting from the present policy, estimated by E[rho - 1 - log rho]
    clipped: Float[Array, ""]  # proportion of the ratios outside 1 +- c


def make_optimiser(settings: PPOSettings) -> optax.GradientTransformation:
    """Return Adam with gradients clipped by their norm, for a rate of one."""
    adam = optax.scale_by_adam(eps=ADAM_EPSILON)
    return optax.chain(optax.clip_by_global_norm(settings.max_grad_norm), adam)


def advantages(
    reward: Float[Array, "t n"],
    value: Float[Array, "t n"],
    next_value: Float[Array, "t n"],
    terminated: Bool[Array, "t n"],
    cut: Bool[Array, "t n"],
    gamma: float,
    lam: float,
) -> Float[Array, "t n"]:
    """Compute generalised advantages; ``cut``: no later step belongs to the same episode."""
    delta = reward + gamma * jnp.where(terminated, 0.0, next_value) - value

    def back(later: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        error, ends = step
        now = error + gamma * lam * jnp.where(ends, 0.0, later)
        return now, now

    return jax.lax.scan(back, jnp.zeros_like(delta[0]), (delta, cut), reverse=True)[1]


def batch_of(network: ActorCritic, record: Record, settings: PPOSettings) -> Batch:
    """Return the transitions of a record with their advantages and value targets."""
    shape = record.reward.shape
    flat = lambda a: a.reshape(shape[0] * shape[1], *a.shape[2:])
    value = network.values(flat(record.inputs)).reshape(shape)
    next_value = network.values(flat(record.next_inputs)).reshape(shape)
    cut = record.terminated | record.truncated | record.begun
    found = advantages(record.reward, value, next_value, record.terminated, cut, settings.gamma, settings.gae_lambda)
    weight = 1.0 - record.begun.astype(jnp.float32)
    parts = record.inputs, record.action, record.log_density, found, found + value, weight
    return Batch(*map(flat, parts))


def loss(network: ActorCritic, batch: Batch, settings: PPOSettings) -> tuple[Float[Array, ""], Statistics]:
    """Return the loss of a batch, whose advantages are standardised, and its statistics."""
    share = batch.weight / jnp.maximum(jnp.sum(batch.weight), 1.0)
    mean = lambda values: jnp.sum(share * values)
    centred = batch.advantage - mean(batch.advantage)
    advantage = centred / (jnp.sqrt(mean(centred**2)) + LEAST_DEVIATION)
    change = network.log_density(batch.inputs, batch.action) - batch.log_density
    ratio, most = jnp.exp(change), settings.clip_range
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - most, 1.0 + most) * advantage)
    value_loss = mean((batch.target - network.values(batch.inputs)) ** 2)
    entropy = network.entropy()
    total = -mean(gain) + settings.vf_coef * value_loss - settings.ent_coef * entropy
    clipped = mean(jnp.abs(ratio - 1.0) > most)
    return total, Statistics(-mean(gain), value_loss, entropy, mean(ratio - 1.0 - change), clipped)


def improve(
    network: ActorCritic, optimised: Any, batch: Batch, rate: Array, key: PRNGKeyArray, settings: PPOSettings
) -> tuple[ActorCritic, Any, Statistics]:
    """Improve the networks in several passes over shuffled parts of the batch."""
    optimiser = make_optimiser(settings)
    n = len(batch.weight)

    def on_part(carry: tuple[ActorCritic, Any], index: Array) -> tuple[tuple[ActorCritic, Any], Statistics]:
        network, optimised = carry
        part = jax.tree.map(lambda a: a[index], batch)
        (_, statistics), gradient = eqx.filter_value_and_grad(loss, has_aux=True)(network, part, settings)
        updates, optimised = optimiser.update(gradient, optimised)
        change = jax.tree.map(lambda update: -rate * update, updates)
        return (eqx.apply_updates(network, change), optimised), statistics

    def on_pass(carry: tuple[ActorCritic, Any], key: Array) -> tuple[tuple[ActorCritic, Any], Statistics]:
        order = jax.random.permutation(key, n).reshape(-1, min(settings.batch_size, n))
        return jax.lax.scan(on_part, carry, order)

    passes = jax.random.split(key, settings.n_epochs)
    (network, optimised), statistics = jax.lax.scan(on_pass, (network, optimised), passes)
    return network, optimised, jax.tree.map(jnp.mean, statistics)
