"""Localizers: what an agent believes about where it is, ``update(command, observation) -> Localization``.

Four ways, one interface: the true pose (oracles only), integrated commands, alignment to the learned map, and alignment
to the previous camera image (SPEC 4: ours, and the baselines that must exist).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.agents.base import AgentContext, Observation
from vssm_gym.camera import Camera
from vssm_gym.errors import InputError
from vssm_gym.geometry import planar_to_matrix
from vssm_gym.inference import tracking
from vssm_gym.inference.tracking import TrackerInfo, TrackerState
from vssm_gym.transition import MotionNoise, PlanarBelief, planar_predict


@dataclass(frozen=True)
class Localization:
    """A Gaussian belief over the planar pose, as agents use it.

    Attributes:
        planar: ``(3,)`` mean x, y (m), heading (rad), float64, map frame.
        std: ``(3,)`` standard deviations of x, y (m) and heading (rad).
        status: "ok", or what is wrong.
    """

    planar: np.ndarray
    std: np.ndarray
    status: str


class Localizer(Protocol):
    """Estimates the pose from the agent's own commands and observations."""

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Start at ``context.start_pose``, with the first observation seen from there."""
        ...

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """The belief after ``command`` ``(turn, o, s)`` was sent and ``observation`` came back."""
        ...


class TruePose:
    """The simulator's pose, read from ``observation["pose"]``: for the oracle only."""

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """The true pose of the first observation."""
        return self._read(observation)

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """The true pose, whatever was commanded."""
        return self._read(observation)

    def _read(self, observation: Observation) -> Localization:
        if "pose" not in observation:
            raise InputError("observation", "pose", "the true pose: make the environment with observe_pose=True")
        return Localization(np.asarray(observation["pose"], np.float64), np.zeros(3), "ok")


class DeadReckoning:
    """Integrates the commands without their noise, and its covariance: the prediction of SPEC 6, never corrected."""

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """The known start, without doubt."""
        self._noise = MotionNoise(*context.noise)
        self._state = PlanarBelief(jnp.asarray(context.start_pose, jnp.float32), jnp.zeros((3, 3)))
        return self._belief()

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """One step of integration; the observation is not looked at."""
        self._state = _predict(self._state, jnp.asarray(command, jnp.float32), self._noise)
        return self._belief()

    def _belief(self) -> Localization:
        R_world_body = np.asarray(planar_to_matrix(self._state.planar), np.float64)[:3, :3]
        covariance = R_world_body @ np.asarray(self._state.covariance, np.float64) @ R_world_body.T
        return Localization(np.asarray(self._state.planar, np.float64), np.sqrt(np.diag(covariance)), "ok")


class MapLocalizer:
    """The tracker in the learned map: ``argmin -log p(x | z, M) - log p(z | z_prev, u)`` (SPEC 4; TNP-SM).

    ``step`` is the tracker's: one with the arguments and results of :func:`vssm_gym.inference.tracking.step_map`.
    """

    def __init__(self, step: Callable[..., tuple[TrackerState, TrackerInfo]] = tracking.step_map) -> None:
        self._step = step

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Start the tracker; one step is computed and dropped, so that compiling it delays no later one."""
        if context.map is None:
            raise InputError("AgentContext", "map", "a learned map: this localizer tracks in one")
        self._map, self._rig, self._noise = context.map, _rig(context), MotionNoise(*context.noise)
        image = tracking.observe(observation["rgb"], observation["depth"])
        self._state = tracking.first(jnp.asarray(context.start_pose, jnp.float32), image)
        self._step(self._state, jnp.zeros(3), image, self._map, self._rig, self._noise)
        return _belief(self._state, "ok")

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """One step of the tracker against the map."""
        control = jnp.asarray(command, jnp.float32)
        image = tracking.observe(observation["rgb"], observation["depth"])
        self._state, info = self._step(self._state, control, image, self._map, self._rig, self._noise)
        return _belief(self._state, tracking.STATUS[int(info.status)])


class FrameLocalizer:
    """The same solver, aligned to the previous camera image instead of a map (SPEC 4, baseline *no map*)."""

    def reset(self, context: AgentContext, observation: Observation) -> Localization:
        """Start the tracker; one step is computed and dropped, so that compiling it delays no later one."""
        self._rig, self._noise = _rig(context), MotionNoise(*context.noise)
        image = tracking.observe(observation["rgb"], observation["depth"])
        self._state = tracking.first(jnp.asarray(context.start_pose, jnp.float32), image)
        tracking.step_frames(self._state, jnp.zeros(3), image, self._rig, self._noise)
        return _belief(self._state, "ok")

    def update(self, command: np.ndarray, observation: Observation) -> Localization:
        """One step of the tracker against the last image."""
        control = jnp.asarray(command, jnp.float32)
        image = tracking.observe(observation["rgb"], observation["depth"])
        self._state, info = tracking.step_frames(self._state, control, image, self._rig, self._noise)
        return _belief(self._state, tracking.STATUS[int(info.status)])


def _rig(context: AgentContext) -> tracking.RobotRig:
    camera = Camera.from_matrix(context.K, *context.camera)
    return tracking.RobotRig(camera, jnp.asarray(context.T_body_cam, jnp.float32))


def _belief(state: tracking.TrackerState, status: str) -> Localization:
    std = np.sqrt(np.diag(np.asarray(state.covariance, np.float64)))
    return Localization(np.asarray(state.planar, np.float64), std, status)


_predict = jax.jit(planar_predict)
