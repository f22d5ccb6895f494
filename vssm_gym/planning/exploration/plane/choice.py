"""Choose where to drive next: the trajectory with most information a step, of random ones and of paths (eq. P52).

    value = I(M; x_1:T | u_1:T) / steps

Random control sequences from the belief, moved away from obstacles, are what DVBF-LM compares. They end within reach of
a few robot lengths: where all of that is known, none of them is worth much more than another. Paths through the free
space of the map's mean to places all over it are candidates too, each judged by the scans of its end.
"""

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.planning.exploration.plane.controls import (
    ControlSearchConfig,
    controls_of,
    random_turns,
    refine,
    trajectories,
)
from vssm_gym.planning.exploration.plane.information import SampledInformationConfig, facing_x, scan_information
from vssm_gym.planning.exploration.plane.roads import PlaneRoads


@dataclass(frozen=True)
class PlaneChoiceConfig:
    """Configure the choice.

    Args:
        search: of random control sequences.
        information: the estimate.
        paths: to places all over free space, at most; 0: random sequences alone, as published.
        spacing: of the places, m.
        most_penalty: of a sequence that may be driven.
        arriving: steps that a path takes beside its length.
    """

    search: ControlSearchConfig = field(default_factory=ControlSearchConfig)
    information: SampledInformationConfig = field(default_factory=SampledInformationConfig)
    paths: int = 24
    spacing: float = 0.1
    most_penalty: float = 2.0
    arriving: float = 5.0


@dataclass(frozen=True)
class PlaneChoice:
    """Hold what to drive.

    Attributes:
        controls: ``(steps, 3)`` of a random sequence; None where a path is better.
        path: ``(n, 2)`` m; None where a sequence is better.
        nats: of information, expected.
        value: nats a step.
    """

    controls: np.ndarray | None
    path: np.ndarray | None
    nats: float
    value: float


def choose(
    key: PRNGKeyArray,
    model: ScanModel,
    seen: ScanModel,
    transition: Transition,
    belief: GaussianBelief,
    roads: PlaneRoads,
    limits: Float[np.ndarray, "2"],
    dt: float,
    config: PlaneChoiceConfig,
) -> PlaneChoice | None:
    """Return the best of all candidates; None where no sequence is safe and no path leads anywhere.

    Args:
        key: of all draws.
        model: of the scans, with few beams, whose information about the map is valued.
        seen: the same, by which obstacles are avoided; it may know more than what counts as known.
        transition: of the robot.
        belief: of its pose.
        roads: of the mean of what was seen.
        limits: largest turn (rad) and step (m).
        dt: length of a step, s.
        config: sizes.
    """
    paths, ends = _paths(roads, config)
    given = key, model, seen, transition, belief, jnp.asarray(limits, jnp.float32), dt, jnp.asarray(ends, jnp.float32)
    controls, penalty, nats = (np.asarray(a) for a in _judge(*given, config))
    n, steps = config.search.candidates, float(config.search.horizon)
    value = nats[:n] / steps
    value = np.where(penalty <= config.most_penalty, value, -np.inf)
    lengths = np.array([np.hypot(*np.diff(path, axis=0).T).sum() for path in paths])
    along = nats[n : n + len(paths)] / (lengths / limits[1] + config.arriving)
    every = np.concatenate([value, along])
    if not np.isfinite(every).any():
        return None
    k = int(np.argmax(every))
    of_path = k >= n
    return PlaneChoice(
        None if of_path else controls[k], paths[k - n] if of_path else None, float(nats[k]), float(every[k])
    )


def _paths(
    roads: PlaneRoads, config: PlaneChoiceConfig
) -> tuple[list[np.ndarray], Float[np.ndarray, "paths legs 2"]]:
    """Return paths to places, and the points near the end of each at which the robot is to measure."""
    legs, most = config.search.legs, config.paths
    ends = np.zeros((most, legs, 2))
    places = roads.places(config.spacing)
    if len(places) > most:  # all over the space that can be reached, near and far
        places = places[np.unique(np.linspace(0, len(places) - 1, most).round().astype(int))]
    paths = [path for place in places if len(path := roads.path_to(place)) > 1]
    for k, path in enumerate(paths):
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
        wanted = along[-1] - config.spacing * np.arange(legs)[::-1]
        ends[k] = path[np.clip(np.searchsorted(along, wanted), 0, len(path) - 1)]
    return paths, ends


@partial(jax.jit, static_argnames="config")
def _judge(
    key: PRNGKeyArray,
    model: ScanModel,
    seen: ScanModel,
    transition: Transition,
    belief: GaussianBelief,
    limits: Array,
    dt: float,
    ends: Array,
    config: PlaneChoiceConfig,
) -> tuple[Array, Array, Array]:
    """Return the refined sequences, their penalties, and the information of all candidates: sequences, then paths."""
    by_turn, by_search, by_pose, by_map = jax.random.split(key, 4)
    search, draws = config.search, config.information.draws
    turns = random_turns(by_turn, search, limits[0])
    turns, least = refine(by_search, seen, transition, belief, turns, search, limits, dt)
    controls = controls_of(turns, search, limits)
    poses = trajectories(by_pose, transition, belief, controls, draws, dt)
    poses = facing_x(poses[:, :, search.steps - 1 :: search.steps])
    # A path is followed: the pose there is as uncertain as it is here, and one draw errs alike all along.
    off = belief.sample(jax.random.fold_in(by_pose, 1), draws) - belief.mean
    off = off.at[:, 2].set(jnp.arctan2(jnp.sin(off[:, 2]), jnp.cos(off[:, 2])))
    there = jnp.concatenate([ends, jnp.zeros((*ends.shape[:-1], 1))], axis=-1)
    every = jnp.concatenate([poses, there[:, None] + off[None, :, None]], axis=0)
    return controls, least, scan_information(by_map, model, every, config.information)
