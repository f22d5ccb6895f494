"""Hold PPO's networks, optimiser and robots between updates, and save and restore them without pickle."""

from collections import deque
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from vssm_gym.agents.policy.features import size_of
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import open_file
from vssm_gym.files.npz_file import open_npz
from vssm_gym.training.config import PPOSettings, TrainingConfig
from vssm_gym.training.environment import BODY, drawn_for, make_observing, stream
from vssm_gym.training.ppo_jax import rollout
from vssm_gym.training.ppo_jax.network import ActorCritic, Layers, make_network
from vssm_gym.training.ppo_jax.rollout import Robots, Task
from vssm_gym.training.ppo_jax.update import Statistics, batch_of, improve, make_optimiser
from vssm_gym.training.run import WINDOW, TrainingProgress

CHECKPOINT_BYTES = 1 << 30  # of parameters and two moments of each


class Ended(eqx.Module):
    """Hold the steps of a rollout at which episodes ended, and what those were."""

    ended: Array  # (T, n)
    returned: Array
    length: Array
    success: Array


class Learner:
    """Train by PPO in the world model of a configuration.

    Attributes:
        steps: of all robots together.
        statistics: of the last update.
    """

    def __init__(self, config: TrainingConfig) -> None:
        assert config.algorithm.name == "ppo_jax"
        self._settings: PPOSettings = config.algorithm
        where = config.environment
        self._n, self._seed = where.num_envs, config.seed
        env: Any = make_observing(where, **drawn_for(where, config.policy.inputs, config.seed))
        env = env.unwrapped
        self._task = Task(
            env.robot,
            env.world,
            jnp.asarray(BODY.low, jnp.float32),
            jnp.asarray(BODY.high, jnp.float32),
            config.policy.inputs,
            config.policy.frames,
            where.contact_cost,
        )
        inputs = config.policy.frames * size_of(config.policy.inputs)
        network, self._key = jax.random.split(jax.random.key(config.seed))
        self._network = make_network(
            inputs, len(BODY.low), config.policy.hidden, config.policy.activation, self._settings.log_std_init, network
        )
        self._optimised = make_optimiser(self._settings).init(eqx.filter(self._network, eqx.is_array))
        self._robots: Robots | None = None
        self.steps = 0
        self.statistics: dict[str, float] = {}
        self._episodes: deque[tuple[float, int, bool]] = deque(maxlen=WINDOW)

    def update(self, rate: float) -> None:
        """Let the robots act, and improve the networks with this learning rate."""
        if self._robots is None:
            self._robots = rollout.begin(self._task, self._n, jax.random.key(stream(self._seed, self.steps)))
        carried = self._network, self._optimised, self._robots, self._key
        *updated, ended, statistics = _update((self._task, jnp.float32(rate), self._settings), carried)
        self._network, self._optimised, self._robots, self._key = updated
        self.steps += self._n * self._settings.n_steps
        ended = jax.device_get(ended)
        which = ended.ended
        self._episodes.extend(
            zip(
                ended.returned[which].tolist(),
                ended.length[which].tolist(),
                ended.success[which].tolist(),
                strict=True,
            )
        )
        self.statistics = {name: round(float(value), 6) for name, value in vars(jax.device_get(statistics)).items()}

    def progress(self) -> TrainingProgress:
        """Return the progress: means over the last WINDOW episodes."""
        columns = np.array(self._episodes, np.float64).reshape(-1, 3)
        means = columns.mean(axis=0).tolist() if len(columns) else [None] * 3
        return TrainingProgress(self.steps, len(columns), *means)

    def policy_layers(self) -> Layers:
        """Return ``(weight, bias)`` of each layer from observation to action, float32."""
        return self._network.policy_layers()

    def leaves(self) -> list[Array]:
        """Return the arrays of networks, optimiser and random key, which a checkpoint holds."""
        return jax.tree.leaves(eqx.filter(self._state(), eqx.is_array))

    def save(self, path: Path, seconds: float) -> None:
        """Save what a training resumes from: networks, optimiser, random key, steps, seconds; whole or not at all."""
        arrays = {f"leaf{i}": np.asarray(leaf) for i, leaf in enumerate(self.leaves())}
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez(file, steps=np.int64(self.steps), seconds=np.float64(seconds), **arrays)  # type: ignore[arg-type]

    def restore(self, path: Path) -> float:
        """Restore what :meth:`save` wrote of the same configuration; return the seconds trained so far.

        Raises :class:`InputError` for a file that is not such a checkpoint.
        """
        expected = "a checkpoint of this training, which `vssm-gym train` wrote"
        leaves = self.leaves()
        with open_npz(open_file(path), path, CHECKPOINT_BYTES, expected) as stored:
            wanted = {f"leaf{i}": leaf.shape for i, leaf in enumerate(leaves)} | {"steps": (), "seconds": ()}
            if stored.shapes != wanted:
                raise InputError(path, "file", f"{expected}; its arrays have other shapes")
            read = [stored.read(f"leaf{i}") for i in range(len(leaves))]
            steps, seconds = int(stored.read("steps")), float(stored.read("seconds"))
        pairs = zip(read, leaves, strict=True)
        if steps < 0 or not all(np.isfinite(one).all() and one.dtype == was.dtype for one, was in pairs):
            raise InputError(path, "file", f"{expected}; found numbers that it cannot have written")
        structure = jax.tree.structure(eqx.filter(self._state(), eqx.is_array))
        network, optimised, key = jax.tree.unflatten(structure, list(map(jnp.asarray, read)))
        self._network, self._optimised = (
            eqx.combine(new, old) for new, old in ((network, self._network), (optimised, self._optimised))
        )
        self._key, self.steps = jax.random.wrap_key_data(key), steps
        return seconds

    def _state(self) -> tuple[ActorCritic, Any, Array]:
        return self._network, self._optimised, jax.random.key_data(self._key)


@eqx.filter_jit(donate="all-except-first")
def _update(
    given: tuple[Task, Array, PPOSettings], carried: tuple[ActorCritic, Any, Robots, PRNGKeyArray]
) -> tuple[ActorCritic, Any, Robots, PRNGKeyArray, Ended, Statistics]:
    (task, rate, settings), (network, optimised, robots, key) = given, carried
    key, shuffle = jax.random.split(key)
    robots, record = rollout.act(task, network, robots, settings.n_steps)
    batch = batch_of(network, record, settings)
    network, optimised, statistics = improve(network, optimised, batch, rate, shuffle, settings)
    ended = Ended(record.terminated | record.truncated, record.returned, record.length, record.success)
    return network, optimised, robots, key, ended, statistics
