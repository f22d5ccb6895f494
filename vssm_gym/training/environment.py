"""Build the vector environment of a training: observations as feature vectors, actions in [-1, 1], no stop.

It is imagined (WorldModelNav) or simulated (PointNav, wrapped to observe the same, or PointNavGPS), by the
configuration. Episodes end on arrival: a policy that may stop by chance would end nearly all of its first episodes at
once, and learn nothing. On the robot the agent stops by its estimate (:mod:`vssm_gym.agents.policy.agent`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space

import vssm_gym  # noqa: F401  (registers the environments)
from vssm_gym.agents.policy.command_history import CommandHistory
from vssm_gym.agents.policy.features import features, size_of
from vssm_gym.envs.conventions.actions import from_unit
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scan_wrapper import VectorScanObservation
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.navigation import SUCCESS
from vssm_gym.envs.vector_wrappers import RelativeGoal
from vssm_gym.envs.world_model.config import Imagination, checked_stds
from vssm_gym.envs.world_model.motion import estimated_pose
from vssm_gym.errors import InputError
from vssm_gym.geometry.scan import BEAMS, MAX_DEPTH
from vssm_gym.maps.map_file import map_hash
from vssm_gym.training.config import SENSED, WORLD_MODEL, EnvironmentSettings

SCAN_CAMERA = CameraConfig(BEAMS, 1)  # of PointNav: its pixels are the rays of a scan


@dataclass(frozen=True)
class Body:
    """Hold what a policy file stores of robot and scan; SI units."""

    low: np.ndarray  # (3,) turn, direction, step
    high: np.ndarray
    success_radius: float
    hfov: float = CameraConfig().hfov
    max_depth: float = MAX_DEPTH

    @classmethod
    def of(cls, robot: HolonomicRobot) -> "Body":
        """Return the limits of the holonomic robot."""
        low = np.array([-robot.max_turn, -robot.max_offset, 0.0])
        return cls(low, robot.limits, SUCCESS * robot.body_length)


BODY = Body.of(HolonomicRobot())


class PolicyView(VectorWrapper):
    """Convert observations to ``(n, features)`` and actions ``(n, 3)`` in [-1, 1] to commands; add ``is_success``.

    Args:
        env: observes ``scan``, ``goal`` from the robot, ``pose``; takes (turn, o, s, stop).
        parts: of the observation that the policy sees.
        contact_cost: subtracted from the reward of a step in contact, because trackers lose track in collisions.

    Attributes:
        shown: the last observations of ``env``, and the last commands.
    """

    def __init__(self, env: VectorEnv, parts: tuple[str, ...], contact_cost: float = 0.0) -> None:
        super().__init__(env)
        self.parts, self.contact_cost = parts, contact_cost
        self.shown: dict[str, np.ndarray] = {}
        self._history = CommandHistory(self.num_envs)
        size = size_of(parts)
        self.single_observation_space = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.single_action_space = gym.spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes; infos are empty."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._features(observations, infos), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, Any, Any, Any, dict[str, Any]]:
        """Carry out actions in [-1, 1]; infos state whether ended episodes succeeded."""
        sent = commands(actions)
        self._history.add(sent[:, :3])
        observations, rewards, terminated, truncated, infos = self.env.step(sent)
        rewards = rewards - self.contact_cost * np.asarray(infos["collision"])
        ended = terminated | truncated
        success = {"is_success": terminated.copy(), "_is_success": ended} if ended.any() else {}  # it ends on arrival
        return self._features(observations, infos), rewards, terminated, truncated, success

    def _features(self, observations: dict[str, np.ndarray], infos: dict[str, Any]) -> np.ndarray:
        """Return the vectors; robots whose episode has begun have no last command."""
        self._history.begin(np.asarray(infos.get("_start_pose", np.zeros(self.num_envs, bool))))
        self.shown = observations | {"commands": self._history.commands}
        return features(self.shown, self.parts)


def commands(actions: np.ndarray) -> np.ndarray:
    """Convert actions ``(n, 3)`` in [-1, 1] to commands ``(n, 4)`` float32 (turn, o, s, stop = 0)."""
    driven = from_unit(np.asarray(actions), BODY.low, BODY.high)
    return np.concatenate([driven, np.zeros((len(driven), 1))], axis=-1).astype(np.float32)


def make_training_env(settings: EnvironmentSettings, parts: tuple[str, ...], seed: int) -> PolicyView:
    """Make the environment of a configuration; in a map each training ``seed`` draws a pool of tasks of its own.

    Raises :class:`InputError` for an invalid map, scene or keyword.
    """
    return PolicyView(make_observing(settings, **drawn_for(settings, parts, seed)), parts, settings.contact_cost)


def drawn_for(settings: EnvironmentSettings, parts: tuple[str, ...], seed: int) -> dict[str, Any]:
    """Return the keywords of a world model that depend on the training's seed and its policy's inputs."""
    return {"pool_seed": seed, "show_uncertainty": "pose_std" in parts} if settings.id == WORLD_MODEL else {}


def make_observing(settings: EnvironmentSettings, **more: Any) -> VectorEnv:
    """Make the environment with observations ``scan, goal`` and, but for PointNavGPS, ``pose``, and SI commands.

    ``more`` are its keywords.
    """
    shared = {"num_envs": settings.num_envs, "max_episode_steps": settings.max_episode_steps, "end_on": "reach"}
    keywords: dict[str, Any] = shared | more | settings.keywords
    # YAML has lists only, the constructors take tuples
    keywords = {name: tuple(value) if isinstance(value, list) else value for name, value in keywords.items()}
    if settings.id == WORLD_MODEL:
        return gym.make_vec(settings.id, map=settings.map, **{"transition": settings.transition} | keywords)
    keywords |= {"scene": settings.scene, "camera": SCAN_CAMERA}
    if settings.id == SENSED:  # its goal is relative already
        return VectorScanObservation(gym.make_vec(settings.id, images=("depth",), actions="metric", **keywords))
    spread = keywords.pop("pose_std", (0.0, 0.0, 0.0))
    try:
        env = gym.make_vec(settings.id, observe_pose=True, **keywords)
    except TypeError as error:
        raise InputError(settings.id, "keywords", f"those of the environment ({error})") from error
    return VectorScanObservation(RelativeGoal(EstimatedPose(env, spread)))


class EstimatedPose(VectorWrapper):
    """Add a tracker's error to observed poses, with the law of the world model, from an exact start on.

        e' = rho e + sqrt(1 - rho^2) n,  n ~ N(0, std^2)

    The standard deviation of the error is ``pose_std`` of the observations, as in the world model.

    Args:
        env: observes ``pose``.
        std: of the error: forward (m), left (m), turn (rad); rho is ``Imagination.pose_memory``.
    """

    def __init__(self, env: VectorEnv, std: Sequence[float]) -> None:
        super().__init__(env)
        checked_stds("pose_std", std)
        self._std, self._memory = np.asarray(std), Imagination.pose_memory
        self._error, self._variance = np.zeros((self.num_envs, 3)), np.zeros((self.num_envs, 3))
        self._rng = np.random.default_rng()

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin episodes: of all environments, or of those in ``options["reset_mask"]``."""
        observations, infos = self.env.reset(seed=seed, options=options)
        seeds = [one for one in np.atleast_1d(np.array(seed, object)) if one is not None]
        if seeds:
            self._rng = np.random.default_rng([int(one) for one in seeds])
        return self._with_errors(observations, infos), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Carry out ``actions`` and advance the errors."""
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        rho, spread = self._memory, 1.0 - self._memory**2
        self._error = rho * self._error + np.sqrt(spread) * self._std * self._rng.standard_normal(self._error.shape)
        self._variance = rho**2 * self._variance + spread * self._std**2
        return self._with_errors(observations, infos), rewards, terminated, truncated, infos

    def _with_errors(self, observations: dict[str, Any], infos: dict[str, Any]) -> dict[str, Any]:
        begun = infos.get("_start_pose", np.zeros(self.num_envs, bool))
        self._error[begun] = self._variance[begun] = 0.0
        pose = np.asarray(estimated_pose(jnp.asarray(observations["pose"]), jnp.asarray(self._error)))
        return observations | {"pose": pose, "pose_std": np.sqrt(self._variance)}


def world_hash(settings: EnvironmentSettings) -> str:
    """Return 16 hex digits of the content of the map, or of the scene."""
    if settings.id == WORLD_MODEL:
        path = Path(settings.map or "")
        if not path.is_file():
            raise InputError(path, "file", "an existing map file (.npz); `vssm-gym map build` makes one")
        return map_hash(path)
    return load_scene(settings.scene or "").content_hash()[:16]


def stream(seed: int, steps: int) -> int:
    """Return the first robot's seed after ``steps`` of a training; other robots' seeds follow consecutively."""
    return int(np.random.SeedSequence([seed, steps]).generate_state(1)[0] // 2)
