"""Let n imagined robots act for some steps inside a compiled program, and record what they did.

An episode that has ended begins anew in the next step, which ignores its action. That step is no transition: the
record marks it as ``begun``, and it has weight 0 in an update.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from vssm_gym.agents.policy.features import LAST_COMMANDS, features, size_of
from vssm_gym.envs.world_model import step as imagination
from vssm_gym.envs.world_model.step import BatchState, Outcome
from vssm_gym.envs.world_model.world import ImaginedWorld, Robot
from vssm_gym.training.ppo_jax.network import ActorCritic


class Task(eqx.Module):
    """Define what is learned: a robot in a world, and what a policy sees of it.

    Attributes:
        robot: static.
        world: map, pool of tasks and rules.
        low, high: commands at actions of -1 and 1.
        parts: of the observation (:mod:`vssm_gym.agents.policy.features`).
        frames: number of last feature vectors that are the input.
        contact_cost: of a step in contact.
    """

    robot: Robot = eqx.field(static=True)
    world: ImaginedWorld
    low: Float[Array, "3"]
    high: Float[Array, "3"]
    parts: tuple[str, ...] = eqx.field(static=True)
    frames: int = eqx.field(static=True)
    contact_cost: float = eqx.field(static=True)


class Robots(eqx.Module):
    """Hold the state of n robots between two steps."""

    state: BatchState
    inputs: Float[Array, "n frames features"]  # oldest first, zeros before the first of an episode
    commands: Float[Array, "n last 3"]  # newest first, zeros before the first of an episode
    returned: Float[Array, "n"]  # rewards of the episode so far
    key: PRNGKeyArray  # of exploration


class Record(eqx.Module):
    """Hold T steps of n robots; leading axes ``(T, n)``."""

    inputs: Float[Array, "*steps inputs"]
    action: Float[Array, "*steps 3"]  # as drawn, before it is clipped
    log_density: Float[Array, "*steps"]
    reward: Float[Array, "*steps"]
    terminated: Bool[Array, "*steps"]
    truncated: Bool[Array, "*steps"]
    begun: Bool[Array, "*steps"]
    success: Bool[Array, "*steps"]
    returned: Float[Array, "*steps"]  # rewards of the episode up to this step
    length: Int[Array, "*steps"]  # steps of the episode up to this one
    next_inputs: Float[Array, "*steps inputs"]  # what was seen after the step, of the same episode


def begin(task: Task, n: int, key: PRNGKeyArray) -> Robots:
    """Begin an episode of n robots, each with a random stream of its own."""
    of_robots, of_actions = jax.random.split(key)
    streams = jax.random.key_data(jax.random.split(of_robots, n))
    state = eqx.tree_at(lambda s: s.key, imagination.empty_state(task.world, n), streams)
    state = imagination.begin(task.robot, task.world, state, None)
    commands = jnp.zeros((n, LAST_COMMANDS, 3))
    inputs = jnp.zeros((n, task.frames, size_of(task.parts)))
    shown = _seen(task, imagination.observe(task.world, state), commands)
    return Robots(state, inputs.at[:, -1].set(shown), commands, jnp.zeros(n), of_actions)


def act(task: Task, network: ActorCritic, robots: Robots, steps: int) -> tuple[Robots, Record]:
    """Let all robots act for ``steps`` steps by a fixed network."""

    def one(robots: Robots, _: None) -> tuple[Robots, Record]:
        key, of_action = jax.random.split(robots.key)
        inputs = robots.inputs.reshape(len(robots.inputs), -1)
        action, log_density = network.sample(inputs, of_action)
        command = task.low + 0.5 * (jnp.clip(action, -1.0, 1.0) + 1.0) * (task.high - task.low)
        sent = jnp.concatenate([command, jnp.zeros_like(command[:, :1])], axis=-1)  # a policy never stops
        state, outcome = imagination.step(task.robot, task.world, robots.state, sent)
        begun = outcome.begun
        reward = jnp.where(begun, 0.0, outcome.reward - task.contact_cost * outcome.collision)
        commands = jnp.concatenate([command[:, None], robots.commands[:, :-1]], axis=1)
        commands = jnp.where(begun[:, None, None], 0.0, commands)
        past = jnp.where(begun[:, None, None], 0.0, robots.inputs[:, 1:])
        shown = jnp.concatenate([past, _seen(task, outcome.observation, commands)[:, None]], axis=1)
        returned = jnp.where(begun, 0.0, robots.returned + reward)
        record = _record(inputs, action, log_density, reward, outcome, returned, state.steps, shown)
        return Robots(state, shown, commands, returned, key), record

    return jax.lax.scan(one, robots, None, steps)


def _record(
    inputs: Array,
    action: Array,
    log_density: Array,
    reward: Array,
    outcome: Outcome,
    returned: Array,
    length: Array,
    shown: Array,
) -> Record:
    ends = outcome.terminated, outcome.truncated, outcome.begun, outcome.success
    return Record(inputs, action, log_density, reward, *ends, returned, length, shown.reshape(len(shown), -1))


def _seen(task: Task, observation: Mapping[str, Array], commands: Array) -> Float[Array, "n features"]:
    return features({**observation, "commands": commands}, task.parts, jnp)
