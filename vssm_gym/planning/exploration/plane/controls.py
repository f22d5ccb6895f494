"""Draw random control sequences and move them away from obstacles, in the model alone (eq. P51).

    u ~ turns that hold for a few steps, slower where they are sharp
    penalty(u) = E_z sum_t sum_b sigmoid((r_0 - r_b(z_t)) / w),    z_1:T ~ q(z_0) prod p(z_t | z_t-1, u_t)
    u <- u' where penalty(u') <= penalty(u),    u' = u + e,    again and again

``r_b`` are the ranges that the map's mean predicts. They are differentiable only where a beam does not leave a corner:
the sequences are refined by perturbations, one at a time for each, all in a batch.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief


@dataclass(frozen=True)
class ControlSearchConfig:
    """Configure candidates and their refinement; lengths in metres.

    Args:
        candidates: sequences.
        legs: pieces of a sequence in which the turn is constant; a scan is judged after each.
        steps: of a leg.
        rounds: of refinement.
        draws: of the trajectory, over which the penalty is averaged.
        clear: r_0, range from the robot's centre below which a beam counts as dangerous.
        width: w, of the sigmoid.
        spread: standard deviation of a perturbation, as a share of the largest turn.
    """

    candidates: int = 12
    legs: int = 4
    steps: int = 5
    rounds: int = 4
    draws: int = 4
    clear: float = 0.02
    width: float = 0.003
    spread: float = 0.15

    def __post_init__(self) -> None:
        for name in ("candidates", "legs", "steps", "draws"):
            if getattr(self, name) < 1:
                raise InputError("ControlSearchConfig", name, f"at least 1, not {getattr(self, name)}")
        if self.rounds < 0:
            raise InputError("ControlSearchConfig", "rounds", f"at least 0, not {self.rounds}")

    @property
    def horizon(self) -> int:
        """Return the steps of a sequence."""
        return self.legs * self.steps


def random_turns(
    key: PRNGKeyArray, config: ControlSearchConfig, most: float | Array
) -> Float[Array, "candidates legs"]:
    """Draw the turn of each leg, rad a step: the first as sharp as it may be, so that sequences leave all around."""
    u = jax.random.uniform(key, (config.candidates, config.legs), minval=-1.0, maxval=1.0)
    gentle = u**3
    return most * gentle.at[:, 0].set(u[:, 0])


def controls_of(
    turns: Float[Array, "*batch legs"], config: ControlSearchConfig, limits: Float[Array, "2"]
) -> Float[Array, "*batch horizon 3"]:
    """Return the controls ``(turn, 0, s)`` of every step: a robot that turns sharply drives slowly.

    Args:
        turns: rad a step, of each leg.
        config: steps of a leg.
        limits: largest turn (rad) and step (m).
    """
    turn = jnp.repeat(jnp.clip(turns, -limits[0], limits[0]), config.steps, axis=-1)
    step = limits[1] * jnp.clip(1.0 - 2.0 * jnp.abs(turn) / limits[0], 0.0, 1.0)
    return jnp.stack([turn, jnp.zeros_like(turn), step], axis=-1)


def trajectories(
    key: PRNGKeyArray,
    transition: Transition,
    belief: GaussianBelief,
    controls: Float[Array, "candidates horizon 3"],
    draws: int,
    dt: float,
) -> Float[Array, "candidates draws horizon 3"]:
    """Draw ``z_1:T`` of each sequence; all sequences have the same draws of the start and of the noise."""
    start = belief.sample(jax.random.fold_in(key, 0), draws)
    keys = jax.random.split(jax.random.fold_in(key, 1), controls.shape[1])

    def of_one(sequence: Array) -> Array:
        def advance(z: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            u, k = now
            z = transition.sample(k, z, jnp.broadcast_to(u, (draws, 3)), dt)
            return z, z

        return jnp.moveaxis(jax.lax.scan(advance, start, (sequence, keys))[1], 0, 1)

    return jax.vmap(of_one)(controls)


def penalty(
    model: ScanModel, poses: Float[Array, "candidates draws horizon 3"], config: ControlSearchConfig
) -> Float[Array, "candidates"]:
    """Return the expected penalty of each candidate: about 1 for each beam and step that is too near to something."""
    ranges = jax.lax.map(model.ranges, poses)
    danger = jax.nn.sigmoid((config.clear - ranges) / config.width)
    return jnp.mean(jnp.sum(danger, axis=(-2, -1)), axis=-1)


def refine(
    key: PRNGKeyArray,
    model: ScanModel,
    transition: Transition,
    belief: GaussianBelief,
    turns: Float[Array, "candidates legs"],
    config: ControlSearchConfig,
    limits: Float[Array, "2"],
    dt: float,
) -> tuple[Float[Array, "candidates legs"], Float[Array, "candidates"]]:
    """Return sequences with lower penalties, and these.

    Args:
        key: of the trajectories, the same in every round, and of the perturbations.
        model: of the scans.
        transition: of the robot.
        belief: of its pose.
        turns: of each leg, rad a step.
        config: rounds and sizes.
        limits: largest turn (rad) and step (m).
        dt: length of a step, s.
    """
    by_pose, by_change = jax.random.split(key)

    def cost(turns: Array) -> Array:
        z = trajectories(by_pose, transition, belief, controls_of(turns, config, limits), config.draws, dt)
        return penalty(model, z, config)

    def improve(carry: tuple[Array, Array], k: PRNGKeyArray) -> tuple[tuple[Array, Array], None]:
        turns, least = carry
        other = turns + config.spread * limits[0] * jax.random.normal(k, turns.shape)
        found = cost(other)
        better = found <= least
        return (jnp.where(better[:, None], other, turns), jnp.where(better, found, least)), None

    keys = jax.random.split(by_change, config.rounds)
    (turns, least), _ = jax.lax.scan(improve, (turns, cost(turns)), keys)
    return turns, least
