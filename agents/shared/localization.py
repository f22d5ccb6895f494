"""Localise an agent: ``update(command, observation) -> Localization``.

The pose is the true one (oracles only), or the belief of any filter over the pose: integrated commands, alignment to
the learned map, alignment to the previous camera image (the tracker of TNP-SM and the baselines that it is compared
with). What a filter estimates is judged by :mod:`vssm_gym.agents.shared.trust`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.agents.base import AgentContext, Observation
from vssm_gym.agents.shared.map_index import MapIndex, rig_of
from vssm_gym.agents.shared.trust import Judged, JudgedFilter
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.inference.filter import KNOWN_START_STD, Filter
from vssm_gym.inference.registry import FILTERS
from vssm_gym.inference.status import Status
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import GaussianBelief, planar_belief, world_covariance


@dataclass(frozen=True)
class Localization:
    """Hold a Gaussian belief over the planar pose, as agents use it.

    Attributes:
        planar: ``(3,)`` mean x, y (m), heading (rad), float64, map frame.
        std: ``(3,)`` standard deviations of x, y (m) and heading (rad) against the map, by which the agent plans.
        status: of the filter's last step, as judged.
        lost: steps in a row without an estimate that may be believed; 0 where this one may.
        covariance: ``(3, 3)`` of forward, left (m) and turn (rad) in the body frame, of the pose in the world: with the
            drift of a map that the agent builds itself, or the error of a map that was made at estimated poses. None
            where the pose is observed.
    """

    planar: np.ndarray
    std: np.ndarray
    status: Status
    lost: int = 0
    covariance: np.ndarray | None = None


class Localizer(Protocol):
    """Estimate the pose from the agent's own commands and observations."""

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Start at ``context.start_pose``, with the first observation seen from there."""
        ...

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Return the belief after ``command`` ``(turn, o, s)`` was sent and ``observation`` came back."""
        ...


class TruePose:
    """Read the simulator's pose from ``observation["pose"]``; for agents whose pose is observed."""

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Return the true pose of the first observation."""
        return self._read(observation)

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Return the true pose; the command is not used."""
        return self._read(observation)

    def _read(self, observation: Observation) -> Localization:
        if "pose" not in observation:
            raise InputError("observation", "pose", "the true pose: make the environment with observe_pose=True")
        return Localization(np.asarray(observation["pose"], np.float64), np.zeros(3), Status.OK)


class FilteredPose:
    """Estimate the pose by a filter with the robot's transition and camera (TNP-SM).

    Args:
        name: of a filter of :data:`vssm_gym.inference.registry.FILTERS`: ``tracker`` in the learned map, ``frames``
            against the previous image, ``dead_reckoning`` by the commands alone, ``emission`` through the renderer.
        index: of the map, by which a lost robot is found, where it is shared; by default the localizer's own.
    """

    def __init__(self, name: str, index: MapIndex | None = None) -> None:
        self._name, self._entry = name, FILTERS[name]
        self._index = MapIndex() if index is None else index

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Start the filter; one step is computed and dropped, so that compiling it delays no later one."""
        if self._entry.needs_map and context.map is None:
            raise InputError("AgentContext", "map", "a learned map: this localizer tracks in one")
        self._dt = context.dt
        image, voxel_map = self._image(observation), context.map if self._entry.needs_map else None
        dropped, state = start_filter(self._name, context, image, voxel_map)
        dropped.step(state, jnp.zeros(len(context.limits)), image, self._dt)
        self._filter, self._state = start_filter(self._name, context, image, voxel_map)
        self._judged = None
        if not self._entry.blind:
            chained = not (self._entry.needs_map or self._entry.maps)
            find = partial(self._index.relocaliser, context) if self._entry.needs_map else None
            self._judged = JudgedFilter(self._filter, self._state, self._dt, observation, chained, relocaliser=find)
        self._displaced = _displacement(context) if self._entry.needs_map else None
        if self._displaced is not None:
            self._displaced(np.asarray(context.start_pose))  # compiled here
        return localization(known_start(context, self._entry.blind), Status.OK)

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Run one step of the filter, and judge it; without images there is nothing to judge."""
        if self._judged is not None:
            return localized(self._judged.step(command, observation), self._displaced)
        control = jnp.asarray(command, jnp.float32)
        self._state, info = self._filter.step(self._state, control, self._image(observation), self._dt)
        return localization(info.belief, info.status)

    def _image(self, observation: Observation) -> Any:
        """Return the image that the filter reads; None for a filter that reads none."""
        return None if self._entry.blind else RGBD.from_camera(observation["rgb"], observation["depth"])


def known_start(context: AgentContext, exact: bool = False) -> GaussianBelief:
    """Return the belief of a robot that knows its start pose, up to ``KNOWN_START_STD`` unless ``exact``."""
    std = 0.0 if exact else KNOWN_START_STD
    return planar_belief(jnp.asarray(context.start_pose, jnp.float32), std**2 * jnp.eye(3))


def start_filter(name: str, context: AgentContext, image: Any, voxel_map: VoxelMap | None) -> tuple[Filter, Any]:
    """Return a robot's filter and its state after the first image, taken at ``context.start_pose``.

    Args:
        name: of a filter of :data:`vssm_gym.inference.registry.FILTERS`.
        context: camera, motion model and start pose of the robot.
        image: the first RGBD; None for a filter that reads none.
        voxel_map: the learned map, or an empty one for a filter that maps, which consumes it; None for the others.
    """
    entry = FILTERS[name]
    made = entry.make(rig_of(context), context.transition)
    return made, made.init(Posterior(known_start(context, entry.blind), voxel_map), image, jax.random.key(0))


def localization(
    belief: GaussianBelief, status: Status, lost: int = 0, in_world: GaussianBelief | None = None
) -> Localization:
    """Return a planar belief as agents use it.

    Args:
        belief: against the map.
        status: of the filter's last step.
        lost: steps in a row without an estimate that may be believed.
        in_world: the same in the world, by default as against the map.
    """
    stated = belief if in_world is None else in_world
    found = jax.device_get(_arrays(belief, stated.covariance))
    mean, variances, covariance = (np.asarray(values, np.float64) for values in found)
    return Localization(mean, np.sqrt(variances), status, lost, 0.5 * (covariance + covariance.T))


def localized(judged: Judged, displaced: Callable[[np.ndarray], np.ndarray] | None = None) -> Localization:
    """Return a judged estimate as agents use it.

    Args:
        judged: the estimate in a map.
        displaced: returns the covariance of that map's own error at a pose; None: the map is true, or the agent's own.
    """
    found = localization(judged.belief, judged.status, judged.lost, judged.in_world)
    if displaced is None or found.covariance is None:
        return found
    return replace(found, covariance=found.covariance + displaced(found.planar))


def _displacement(context: AgentContext) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return the covariance of a known map's error at a pose, ``(3, 3)`` in its body frame; None for true poses."""
    errors = None if context.map is None else context.map.pose_errors
    if errors is None:
        return None
    height = float(context.T_body_cam[2, 3])  # of the camera: the surfaces that it is localised by are about as high

    def displaced(planar: np.ndarray) -> np.ndarray:
        p_world = jnp.asarray([planar[0], planar[1], height], jnp.float32)
        R = planar_to_matrix(np.asarray(planar, float))[:3, :3]
        P = np.asarray(_planar_covariance(errors, p_world), float)
        return R.T @ P @ R

    return displaced


_planar_covariance = jax.jit(lambda errors, p_world: errors.planar_covariance(p_world))


_arrays = jax.jit(lambda belief, stated: (belief.mean, jnp.diagonal(world_covariance(belief)), stated))
