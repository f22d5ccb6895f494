"""Implement ``gym.make_vec("vssm_gym/WorldModelNav-v0", map="oak.npz", num_envs=256)``: many robots a compiled step.

Episodes restart as Gymnasium's ``AutoresetMode.NEXT_STEP`` says: the step after the last one of an episode ignores its
action and returns the next episode's first observation with reward 0. ``reset(options={"reset_mask": mask})`` restarts
some at once, as :class:`vssm_gym.training.sb3.SB3VecEnv` does. Observations are read-only views of the computed arrays,
without copies; later steps do not change them.
"""

import math
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from vssm_gym.envs.conventions.relative_goal import MAX_GOAL_DISTANCE
from vssm_gym.envs.rendering.captions import Caption, Panel, Tally
from vssm_gym.envs.rendering.frames import Frames
from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.validation import check_options, choose, vector_seeds
from vssm_gym.envs.world_model.batch_slices import BatchSlices
from vssm_gym.envs.world_model.config import SOURCE, Imagination
from vssm_gym.envs.world_model.picture import PlanPicture
from vssm_gym.envs.world_model.world import build_world, robot_of
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.scan import BEAMS


class WorldModelVectorEnv(VectorEnv):
    """Imagine ``num_envs`` robots in the belief of one map; ``docs/envs/world_model_nav.md`` explains the keywords.

    Args:
        map: a map file's path, or a :class:`~vssm_gym.maps.voxel_map.VoxelMap`.
        num_envs: number of robots.
        max_episode_steps: steps after which an episode is truncated; -1 for none.
        render_mode: ``rgb_array`` or None.
        captions: if True, a strip of text lies below each picture.
        keywords: of :class:`~vssm_gym.envs.world_model.config.Imagination`.
    """

    metadata = {  # noqa: RUF012  (Gymnasium's own declaration)
        "autoreset_mode": AutoresetMode.NEXT_STEP,
        "render_modes": ["rgb_array"],
        "render_fps": 5,
    }

    def __init__(
        self,
        map: Any = None,
        num_envs: int = 1,
        max_episode_steps: int = -1,
        render_mode: str | None = None,
        captions: bool = False,
        **keywords: Any,
    ) -> None:
        choose(SOURCE, "render_mode", render_mode, (None, "rgb_array"))
        config = Imagination.of(keywords)
        for name, value, least in (("num_envs", num_envs, 1), ("max_episode_steps", max_episode_steps, -1)):
            if isinstance(value, bool) or not (isinstance(value, int) and value >= least and value != 0):
                raise InputError("make_vec", name, f"a whole number, at least 1; found {value!r:.80}")
        self.imagination, self.robot = config, robot_of(config)
        self.world = build_world(map, config, self.robot, max_episode_steps)
        self.num_envs, self.max_episode_steps = num_envs, max_episode_steps
        self.frames, self.render_mode = Frames(SOURCE, render_mode, captions), render_mode
        self._tallies = [Tally()] * num_envs
        self.success_radius = round(float(self.world.rules.success_radius), 6)
        self.single_action_space, self.single_observation_space = _action_space(self.robot), _observation_space(config)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._batch = BatchSlices(self.robot, self.world, num_envs)
        self._begun = False
        self._picture: PlanPicture | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode of all robots, or of those of ``options["reset_mask"]``.

        Args:
            seed: of the robots' streams: one a robot, or the first of consecutive ones; None: the streams continue.
            options: ``reset_mask`` ``(num_envs,)`` bool; ``task``: numbers of the pool's tasks, one a robot or one for
                all robots.
        """
        self._check_open()
        options = check_options(options, "reset_mask", "task")
        mask = np.asarray(options.pop("reset_mask", np.ones(self.num_envs, dtype=bool)))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise InputError("reset", "options['reset_mask']", f"{self.num_envs} booleans, one of them true")
        tasks = self._tasks(options.pop("task", None))
        if not (self._begun or mask.all()):
            raise gym.error.ResetNeeded("the first reset is one of all environments: reset_mask comes later")
        self._seed(seed, mask)
        shown = self._batch.restart(mask, tasks)
        self._begun = True
        self._count(mask)
        if self._picture is not None:
            self._picture.forget(np.flatnonzero(mask))
        return self._observation(shown), self._start_infos(mask)

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Carry out one action a robot; robots whose episode has ended begin their next one instead.

        Actions that are not finite or not of the action space's shape raise :class:`InputError` and change nothing.
        """
        self._check_open()
        if not self._begun:
            raise gym.error.ResetNeeded("call reset before step")
        batch = np.asarray(actions)
        if batch.shape != self.action_space.shape or batch.dtype.kind not in "fiu" or not np.isfinite(batch).all():
            found = f"found {batch.dtype} {batch.shape}, {actions!r:.80}"
            raise InputError("step", "actions", f"finite numbers of shape {self.action_space.shape}; {found}")
        outcome = self._batch.step(batch)
        terminated, begun = outcome.terminated, outcome.begun
        everywhere = np.ones(self.num_envs, bool)
        infos: dict[str, Any] = {
            "collision": outcome.collision,
            "_collision": everywhere,
            "control": outcome.command,
            "_control": everywhere,
        }
        if terminated.any():
            infos |= {"success": outcome.success, "_success": terminated}
        if begun.any():
            infos |= self._start_infos(begun)
            if self._picture is not None:
                self._picture.forget(np.flatnonzero(begun))
        reward = outcome.reward.astype(np.float64)
        self._count(begun, outcome)
        return self._observation(outcome.observation), reward, terminated, outcome.truncated, infos

    @property
    def planar(self) -> np.ndarray:
        """Return the true poses of the imagined robots, ``(num_envs, 3)`` x, y (m), heading (rad); not for agents."""
        return np.array(self._batch.state.planar)

    @property
    def goals(self) -> np.ndarray:
        """Return the goals of the present episodes, ``(num_envs, 2)``, m."""
        return np.asarray(self.world.goal_distances.goals)[np.asarray(self.world.pool.goal)[self._batch.state.task]]

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw each robot on the belief's floor plan, uint8 ``(height, width, 3)``; None without ``render_mode``."""
        plans = [] if self.render_mode is None else self.plans()
        return tuple(self.frames.picture([plan], captions) for plan, captions in plans) or None

    def plans(self) -> list[tuple[Panel, list[Caption]]]:
        """Draw each robot on the belief's floor plan, with its captions; none before the first reset."""
        if not self._begun:
            return []
        if self._picture is None:
            self._picture = PlanPicture(self.world.collision_map, self.num_envs)
        plans = self._picture.draw(self.planar, self.goals, self.success_radius, _radius(self.robot))
        away = np.hypot(*(self.planar[:, :2] - self.goals).T)
        rows = zip(plans, self._tallies, away, strict=True)
        return [(plan, tally.captions([Caption("goal", f"{metres:.2f} m")])) for plan, tally, metres in rows]

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return the attribute ``name``, which is the same for every robot, once a robot."""
        return self.call(name)

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """Return the attribute ``name``, called with the arguments where it is a method, once a robot."""
        value = getattr(self, name)
        return tuple(value(*args, **kwargs) if callable(value) else value for _ in range(self.num_envs))

    def set_attr(self, name: str, values: Any) -> None:
        """Raise :class:`InputError`: the robots of one world share all attributes."""
        raise InputError("set_attr", name, "keywords at construction: the robots share one world")

    def _count(self, begun: np.ndarray, outcome: Any = None) -> None:
        """Count a step of every robot, but for those whose episode has begun; only for pictures."""
        if self.render_mode is None:
            return
        for i in range(self.num_envs):
            if begun[i]:
                self._tallies[i] = Tally()
            elif outcome is not None:
                info = {"collision": outcome.collision[i], "success": outcome.success[i]}
                self._tallies[i] = self._tallies[i].after(float(outcome.reward[i]), bool(outcome.terminated[i]), info)

    def _observation(self, shown: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        space: Any = self.single_observation_space
        return {key: shown[key] for key in space}

    def _start_infos(self, mask: np.ndarray) -> dict[str, Any]:
        task = self._batch.state.task
        start = np.asarray(self.world.pool.start)[task]
        return {"task": task, "_task": mask, "start_pose": start, "_start_pose": mask}

    def _check_open(self) -> None:
        if self.closed:
            raise gym.error.ClosedEnvironmentError("the environments are closed: make new ones")

    def _tasks(self, given: Any) -> np.ndarray:
        """Return the numbers of tasks, one a robot; -1 draws one."""
        if given is None:
            return np.full(self.num_envs, -1, np.int32)
        numbers, count = np.asarray(given), int(self.world.pool.count)
        valid = numbers.shape in ((), (self.num_envs,)) and numbers.dtype.kind in "iu"
        if not valid or (numbers < 0).any() or (numbers >= count).any():
            expected = f"a number from 0 to {count - 1}, or {self.num_envs} of them; found {given!r:.80}"
            raise InputError("reset", "options['task']", expected)
        return np.broadcast_to(numbers, (self.num_envs,)).astype(np.int32)

    def _seed(self, seed: Any, mask: np.ndarray) -> None:
        if seed is None and self._begun:
            return
        if seed is None:
            fresh = np.random.SeedSequence().generate_state(2 * self.num_envs, np.uint32)
            keys, mask = fresh.reshape(-1, 2), np.ones(self.num_envs, bool)
        else:
            seeds = vector_seeds(seed, self.num_envs)
            keys = np.array(self._batch.state.key)
            if not self._begun:  # those without a seed of their own
                keys = np.random.SeedSequence().generate_state(keys.size, np.uint32).reshape(keys.shape)
            for i, one in enumerate(seeds):
                if one is not None:
                    keys[i] = (int(one) >> 32) & 0xFFFFFFFF, int(one) & 0xFFFFFFFF
            mask = mask & (np.array([one is not None for one in seeds]) | (not self._begun))
        self._batch.seed(keys, mask)


def _radius(robot: Any) -> float:
    return 0.5 * robot.width if isinstance(robot, Car) else robot.radius


def _action_space(robot: Any) -> gym.spaces.Box:
    """Return the action space of the environment that is imagined."""
    if isinstance(robot, Car):
        high = robot.limits.astype(np.float32)
        return gym.spaces.Box(-high, high)
    turn, offset, reach = robot.limits
    low, most = [-turn, -offset, 0.0, 0.0], [turn, offset, reach, 1.0]
    return gym.spaces.Box(np.array(low, np.float32), np.array(most, np.float32))


def _observation_space(config: Imagination) -> gym.spaces.Dict:
    camera: Any = config.camera
    size = (camera.height, camera.width)
    far = np.array([MAX_COORDINATE, MAX_COORDINATE, math.pi], np.float32)
    low, high = np.array([0.0, -1.0, -1.0], np.float32), np.array([MAX_GOAL_DISTANCE, 1.0, 1.0], np.float32)
    spaces: dict[str, gym.Space[Any]] = {"goal": gym.spaces.Box(low, high), "pose": gym.spaces.Box(-far, far)}
    if config.observation == "scan":
        spaces["scan"] = gym.spaces.Box(0.0, config.max_depth, (BEAMS,), np.float32)
    else:
        spaces["depth"] = gym.spaces.Box(0.0, MAX_COORDINATE, size, np.float32)
    if config.observation == "rgbd":
        spaces["rgb"] = gym.spaces.Box(0, 255, (*size, 3), np.uint8)
    if config.show_uncertainty:
        spaces["pose_std"] = gym.spaces.Box(0.0, MAX_COORDINATE, (3,), np.float32)
    return gym.spaces.Dict(spaces)
