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

from vssm_gym.geometry.transforms import wrap_angle
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
        places: all over free space, at most.
        paths: to the best of them; 0: random sequences alone, as published.
        spacing: of the places, m.
        most_penalty: of a sequence that may be driven.
        arriving: steps that a path takes beside its length.
    """

    search: ControlSearchConfig = field(default_factory=ControlSearchConfig)
    information: SampledInformationConfig = field(default_factory=SampledInformationConfig)
    places: int = 100
    paths: int = 8
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
    given = model, transition, belief, jnp.asarray(limits, jnp.float32), dt
    by_place, by_candidate = jax.random.split(key)
    paths, steps = _paths(by_place, model, belief, roads, limits, config)
    ends = jnp.asarray(_ends(paths, config), jnp.float32)
    controls, penalty, nats = (np.asarray(a) for a in _judge(by_candidate, seen, *given, ends, config))
    n = config.search.candidates
    value = np.where(penalty <= config.most_penalty, nats[:n] / config.search.horizon, -np.inf)
    every = np.concatenate([value, nats[n : n + len(paths)] / steps])
    if not np.isfinite(every).any():
        return None
    k = int(np.argmax(every))
    path = paths[k - n] if k >= n else None
    return PlaneChoice(controls[k] if path is None else None, path, float(nats[k]), float(every[k]))


def _paths(
    key: PRNGKeyArray,
    model: ScanModel,
    belief: GaussianBelief,
    roads: PlaneRoads,
    limits: Float[np.ndarray, "2"],
    config: PlaneChoiceConfig,
) -> tuple[list[np.ndarray], Float[np.ndarray, "paths"]]:
    """Return the paths to the places of most information a step, and the steps of each, its first turn included."""
    places = roads.places(config.spacing)[: config.places]
    if not (config.paths and len(places)):
        return [], np.empty(0)
    filled = np.zeros((config.places, 1, 2), np.float32)
    filled[: len(places), 0] = places
    nats = np.asarray(_judge_places(key, model, belief, jnp.asarray(filled), config))[: len(places)]
    best = np.argsort(-nats / (roads.lengths_to(places) / limits[1] + config.arriving), kind="stable")
    paths = [path for k in best[: config.paths] if len(path := roads.path_to(places[k])) > 1]
    heading, steps = float(belief.mean[2]), np.empty(len(paths))
    for k, path in enumerate(paths):
        ahead = path[min(len(path) - 1, 3)] - path[0]
        turn = abs(wrap_angle(np.arctan2(ahead[1], ahead[0]) - heading))
        steps[k] = _along(path)[-1] / limits[1] + float(turn) / limits[0] + config.arriving
    return paths, steps


def _along(path: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])


def _ends(paths: list[np.ndarray], config: PlaneChoiceConfig) -> Float[np.ndarray, "paths legs 2"]:
    """Return the points near the end of each path at which the robot is to measure; rows of zeros fill the rest."""
    ends = np.zeros((config.paths, config.search.legs, 2))
    for k, path in enumerate(paths):
        along = _along(path)
        wanted = along[-1] - config.spacing * np.arange(config.search.legs)[::-1]
        ends[k] = path[np.clip(np.searchsorted(along, wanted), 0, len(path) - 1)]
    return ends


@partial(jax.jit, static_argnames="config")
def _judge_places(
    key: PRNGKeyArray, model: ScanModel, belief: GaussianBelief, places: Array, config: PlaneChoiceConfig
) -> Array:
    """Return the information of one scan at each place."""
    return scan_information(key, model, _standing(key, belief, places, config), config.information)


def _standing(key: PRNGKeyArray, belief: GaussianBelief, places: Array, config: PlaneChoiceConfig) -> Array:
    """Return draws of poses at places ``(n, times, 2)``, facing x.

    A path is followed: the pose there is as uncertain as it is here, and one draw errs alike all along.
    """
    off = belief.sample(key, config.information.draws) - belief.mean
    off = off.at[:, 2].set(jnp.arctan2(jnp.sin(off[:, 2]), jnp.cos(off[:, 2])))
    there = jnp.concatenate([places, jnp.zeros((*places.shape[:-1], 1))], axis=-1)
    return there[:, None] + off[None, :, None]


@partial(jax.jit, static_argnames="config")
def _judge(
    key: PRNGKeyArray,
    seen: ScanModel,
    model: ScanModel,
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
    every = jnp.concatenate([poses, _standing(by_pose, belief, ends, config)], axis=0)
    return controls, least, scan_information(by_map, model, every, config.information)
