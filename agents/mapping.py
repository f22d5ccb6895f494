"""Mappers: how an explorer's images get into its own map, and where it believes to be meanwhile.

Two settings, one interface: the pose is observed (SPEC 8), or PRISM estimates it together with the map (SPEC 3).
"""

from typing import Protocol

import jax.numpy as jnp
import numpy as np

from vssm_gym.agents.base import AgentContext, Observation
from vssm_gym.agents.localization import Localization, TruePose
from vssm_gym.camera import Camera
from vssm_gym.geometry import planar_to_matrix
from vssm_gym.inference import planar_prism, tracking
from vssm_gym.inference.map_update import update
from vssm_gym.inference.observation import MapUpdateConfig
from vssm_gym.transition import MotionNoise
from vssm_gym.voxel_map import VoxelMap


class Mapper(Protocol):
    """Builds the map and says where the robot is in it."""

    @property
    def map(self) -> VoxelMap:
        """The belief, world frame; valid until the next image."""
        ...

    def reset(self, prior: VoxelMap, context: AgentContext, observation: Observation) -> Localization:
        """Begin with the first observation, seen from ``context.start_pose``; ``prior`` is consumed."""
        ...

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """The belief after ``command`` ``(turn, o, s)`` was sent and ``observation`` came back."""
        ...


class MapAtObservedPose:
    """``q(M | x_<=t, z_<=t)``: the closed-form update at ``observation["pose"]``."""

    def __init__(self) -> None:
        self._pose, self._config = TruePose(), MapUpdateConfig()
        self.map: VoxelMap

    def reset(self, prior: VoxelMap, context: AgentContext, observation: Observation) -> Localization:
        """The first image in the empty map."""
        self.map, self._T_body_cam = prior, np.asarray(context.T_body_cam, np.float64)
        self._camera = Camera.from_matrix(context.K, *context.camera)
        return self._take(self._pose.reset(context, observation), observation)

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """One more image, whatever was commanded."""
        return self._take(self._pose.update(command, observation), observation)

    def _take(self, at: Localization, observation: Observation) -> Localization:
        T_world_cam = jnp.asarray(planar_to_matrix(at.planar) @ self._T_body_cam, jnp.float32)
        depth = jnp.asarray(observation["depth"], jnp.float32)
        rgb = jnp.asarray(observation["rgb"], jnp.float32) / 255.0
        self.map = update(self.map, depth, rgb, T_world_cam, self._camera, self._config)
        return at


class MapAndPose:
    """``q(M, z_t | x_<=t, u_<t)``: :mod:`vssm_gym.inference.planar_prism`; nothing but the start is known.

    An image that does not fit is not put into the map; the status says so until one fits again.
    """

    def reset(self, prior: VoxelMap, context: AgentContext, observation: Observation) -> Localization:
        """The first image at the known start; what a lost robot does is compiled here, so that it delays no step."""
        camera = Camera.from_matrix(context.K, *context.camera)
        self._rig = tracking.RobotRig(camera, jnp.asarray(context.T_body_cam, jnp.float32))
        self._noise = MotionNoise(*context.noise)
        image = tracking.observe(observation["rgb"], observation["depth"])
        self._state = planar_prism.init(prior, jnp.asarray(context.start_pose, jnp.float32), image, self._rig)
        effort = planar_prism.DEFAULT.tracker
        tracking.step_map(self._state.tracked, jnp.zeros(3), image, self.map, self._rig, self._noise, effort)
        return self._belief("ok")

    @property
    def map(self) -> VoxelMap:
        """``q_t(M)``."""
        return self._state.map

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """One step of the filter."""
        image = tracking.observe(observation["rgb"], observation["depth"])
        control = jnp.asarray(command, jnp.float32)
        self._state, info = planar_prism.step(self._state, control, image, self._rig, self._noise)
        return self._belief(tracking.STATUS[int(info.status)])

    def _belief(self, status: str) -> Localization:
        tracked = self._state.tracked
        std = np.sqrt(np.diag(np.asarray(tracked.covariance, np.float64)))
        return Localization(np.asarray(tracked.planar, np.float64), std, status)
