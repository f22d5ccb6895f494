"""Build an explorer's own map from its images, and localise the robot in it.

There are two settings with one interface: the pose is observed (thesis, section 5.6.2), or PRISM estimates it together
with the map.
"""

from dataclasses import replace
from typing import Protocol

import jax.numpy as jnp
import numpy as np

from vssm_gym.agents.base import AgentContext, Observation
from vssm_gym.agents.shared.localization import (
    Localization,
    TruePose,
    known_start,
    localization,
    localized,
    start_filter,
)
from vssm_gym.agents.shared.trust import JudgedFilter
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.inference.mapping.observation import MapUpdateConfig
from vssm_gym.inference.status import Status
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD


class Mapper(Protocol):
    """Build the map and localise the robot in it."""

    @property
    def map(self) -> VoxelMap:
        """Return the belief, world frame; it is valid until the next image."""
        ...

    def reset(self, prior: VoxelMap, context: AgentContext, observation: Observation) -> Localization:
        """Begin with the first observation, seen from ``context.start_pose``; ``prior`` is consumed."""
        ...

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Return the belief after ``command`` ``(turn, o, s)`` was sent and ``observation`` came back."""
        ...


class MapAtObservedPose:
    """``q(M | x_<=t, z_<=t)`` by the closed-form update at ``observation["pose"]``."""

    def __init__(self) -> None:
        self._pose, self._config = TruePose(), MapUpdateConfig()
        self.map: VoxelMap

    def reset(self, prior: VoxelMap, context: AgentContext, observation: Observation) -> Localization:
        """Put the first image into the empty map."""
        self.map, self._T_body_cam = prior, np.asarray(context.T_body_cam, np.float64)
        self._camera = Camera.from_matrix(context.K, *context.camera)
        return self._take(self._pose.reset(context, observation), observation)

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Put one more image into the map; the command is not used."""
        return self._take(self._pose.update(command, observation), observation)

    def _take(self, at: Localization, observation: Observation) -> Localization:
        T_world_cam = jnp.asarray(planar_to_matrix(at.planar) @ self._T_body_cam, jnp.float32)
        depth = jnp.asarray(observation["depth"], jnp.float32)
        rgb = jnp.asarray(observation["rgb"], jnp.float32) / 255.0
        self.map = update(self.map, depth, rgb, T_world_cam, self._camera, self._config)
        return at


class MapAndPose:
    """``q(M, z_t | x_<=t, u_<t)`` by PRISM with the robot's transition; only the start pose is known.

    An image that is not accepted does not enter the map; the status reports this until one is accepted again. Estimates
    are judged by :mod:`vssm_gym.agents.shared.trust`.
    """

    def reset(self, prior: VoxelMap, context: AgentContext, observation: Observation) -> Localization:
        """Put the first image into the map at the known start.

        The step of a lost robot is compiled here, so that it delays no later step.
        """
        image = RGBD.from_camera(observation["rgb"], observation["depth"])
        prism, state = start_filter("prism", context, image, prior)
        # An image without depth fits nothing, so the map stays as it is.
        dark = RGBD.from_camera(np.zeros_like(observation["rgb"]), np.zeros_like(observation["depth"]))
        prism.step(replace(state, lost=True), jnp.zeros(len(context.limits)), dark, context.dt)
        self._judged = JudgedFilter(prism, state, context.dt, observation)
        return localization(known_start(context), Status.OK)

    @property
    def map(self) -> VoxelMap:
        """Return ``q_t(M)``."""
        return self._judged.state.map

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """Run one step of the filter, and judge it; the pose is relative to the map, whose frame may have drifted."""
        return localized(self._judged.step(command, observation))
