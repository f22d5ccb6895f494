"""Test PPO's advantages against their sum and stable-baselines3's buffer, and that begun steps change nothing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.training.config import PPOSettings
from vssm_gym.training.ppo_jax.network import make_network
from vssm_gym.training.ppo_jax.rollout import Record
from vssm_gym.training.ppo_jax.update import advantages, batch_of, improve, loss, make_optimiser

GAMMA, LAM, T, N = 0.97, 0.9, 30, 5
SETTINGS = PPOSettings(name="ppo_jax", batch_size=50, n_epochs=2, gamma=GAMMA, gae_lambda=LAM)


def episodes(seed: int = 0) -> dict[str, np.ndarray]:
    """Return steps with ends of both kinds, each followed by a step that begins an episode."""
    rng = np.random.default_rng(seed)
    drawn = {name: rng.normal(size=(T, N)) for name in ("reward", "value", "next_value")}
    ended, kind = rng.random((T, N)) < 0.15, rng.random((T, N)) < 0.5
    begun = np.zeros((T, N), bool)
    for t in range(1, T):
        begun[t] = ended[t - 1]
        ended[t] &= ~begun[t]
    drawn["reward"][begun] = 0.0
    return drawn | {"terminated": ended & kind, "truncated": ended & ~kind, "begun": begun}


def test_advantages_are_the_discounted_sum_of_temporal_differences():
    """``A_t = sum_k (gamma lambda)^k delta_t+k`` up to the end of the episode, in float64."""
    e = episodes()
    cut = e["terminated"] | e["truncated"] | e["begun"]
    found = advantages(*(jnp.asarray(e[k]) for k in ("reward", "value", "next_value", "terminated")), cut, GAMMA, LAM)
    delta = e["reward"] + GAMMA * e["next_value"] * ~e["terminated"] - e["value"]
    for i in range(N):
        for t in range(T):
            last = next((k for k in range(t, T) if cut[k, i]), T - 1)
            expected = sum((GAMMA * LAM) ** (k - t) * delta[k, i] for k in range(t, last + 1))
            assert float(found[t, i]) == pytest.approx(expected, abs=1e-5)


def test_without_begun_steps_they_are_those_of_stable_baselines3():
    """An episode that restarts at once has the buffer's advantages, whose ends are all terminations."""
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    import gymnasium as gym
    import torch
    from stable_baselines3.common.buffers import RolloutBuffer

    rng = np.random.default_rng(1)
    reward, value = rng.normal(size=(2, T, N)).astype(np.float32)
    ended, last = rng.random((T, N)) < 0.2, rng.normal(size=N).astype(np.float32)
    box = gym.spaces.Box(-1.0, 1.0, (1,))
    buffer = RolloutBuffer(T, box, box, gae_lambda=LAM, gamma=GAMMA, n_envs=N)
    starts = np.concatenate([np.zeros((1, N), bool), ended[:-1]])
    for t in range(T):
        zeros = np.zeros((N, 1), np.float32)
        buffer.add(zeros, zeros, reward[t], starts[t], torch.from_numpy(value[t]), torch.zeros(N))
    buffer.compute_returns_and_advantage(torch.from_numpy(last), ended[-1])
    following = np.concatenate([value[1:], last[None]])
    found = advantages(*map(jnp.asarray, (reward, value, following, ended, ended)), GAMMA, LAM)
    np.testing.assert_allclose(found, buffer.advantages, atol=1e-5)


def record(seed: int, junk: float) -> Record:
    """Return a record whose begun steps hold ``junk``."""
    e, rng = episodes(seed), np.random.default_rng(seed)
    numbers = {name: rng.normal(size=(T, N, k)) for name, k in (("inputs", 4), ("action", 3), ("next", 4))}
    numbers["inputs"][e["begun"]] += junk
    numbers["action"][e["begun"]] += junk
    f = lambda a: jnp.asarray(a, jnp.float32)
    zero = jnp.zeros((T, N))
    return Record(
        f(numbers["inputs"]),
        f(numbers["action"]),
        jnp.full((T, N), -3.0),
        f(e["reward"]),
        jnp.asarray(e["terminated"]),
        jnp.asarray(e["truncated"]),
        jnp.asarray(e["begun"]),
        jnp.asarray(e["terminated"]),
        zero,
        zero.astype(jnp.int32),
        f(numbers["next"]),
    )


def test_steps_that_begin_an_episode_change_nothing():
    """The loss and its gradient do not depend on the action that a beginning ignored, nor on what was seen before."""
    network = make_network(4, 3, (8,), "tanh", -0.5, jax.random.key(0))
    grads = []
    for junk in (0.0, 5.0):
        batch = batch_of(network, record(2, junk), SETTINGS)
        grads.append(jax.tree.leaves(jax.grad(lambda n, b=batch: loss(n, b, SETTINGS)[0])(network)))
    assert all(np.abs(leaf).max() > 0.0 for leaf in grads[0][:2])
    for one, other in zip(*grads, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_an_update_raises_the_density_of_actions_that_were_better_than_expected():
    network = make_network(4, 3, (8,), "tanh", -0.5, jax.random.key(0))
    batch = batch_of(network, record(3, 0.0), SETTINGS)
    log_density = network.log_density(batch.inputs, batch.action)
    batch = jax.tree.map(lambda a: a, batch)
    acting = type(batch)(batch.inputs, batch.action, log_density, batch.advantage, batch.target, batch.weight)
    first = make_optimiser(SETTINGS).init(network)
    after, _, statistics = improve(network, first, acting, jnp.float32(1e-2), jax.random.key(1), SETTINGS)
    change = after.log_density(acting.inputs, acting.action) - log_density
    valid = acting.weight > 0.0
    assert float(jnp.corrcoef(change[valid], acting.advantage[valid])[0, 1]) > 0.1
    assert float(statistics.divergence) > 0.0 and 0.0 <= float(statistics.clipped) <= 1.0


def test_a_policy_is_a_gaussian():
    """Densities integrate to the entropy: its mean log density is minus the entropy."""
    network = make_network(4, 3, (8, 6), "relu", -0.3, jax.random.key(0))
    x = jnp.tile(jnp.arange(4.0), (20_000, 1))
    action, log_density = network.sample(x, jax.random.key(1))
    assert -float(log_density.mean()) == pytest.approx(float(network.entropy()), abs=0.03)
    np.testing.assert_allclose(network.log_density(x, action), log_density, atol=1e-5)
    np.testing.assert_allclose(action.mean(axis=0), network.mean(x)[0], atol=0.03)
