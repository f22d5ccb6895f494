"""Define PointNav: a noisy robot with an RGB-D camera drives to a point of a furnished apartment.

The robot knows its start and its goal, then observes images only. It acts ``(turn, o, s, stop)`` at 5 Hz with seeded
execution noise, collides with walls and furniture, and decides itself when it has arrived. The tables of observation,
action, reward and termination are in ``docs/envs/pointnav.md``.
"""

import warnings
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from vssm_gym.envs.conventions.relative_goal import (
    GOAL_FORMS,
    GoalForm,
    is_reckoned,
    reckoned,
    relative_goal,
    sensed_pose,
    with_relative_goal,
)
from vssm_gym.envs.phased import PhasedEnv
from vssm_gym.envs.rendering.captions import Caption, Panel
from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.scenes.faults import SceneWarning
from vssm_gym.envs.sensors.task_observation import TaskObservation
from vssm_gym.envs.simulation import Simulation
from vssm_gym.envs.tasks.navigation import SUCCESS, Task, TaskSet, checked_set
from vssm_gym.envs.tasks.rewards import DenseReward
from vssm_gym.envs.validation import check_options, choose
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose

POINTNAV_REWARD = DenseReward(step_cost=0.01, success=2.5)  # in metres gained


class PointNavEnv(PhasedEnv):
    """Simulate one robot that drives to a point of an apartment.

    Registered as ``vssm_gym/PointNav-v0``, truncated after 500 steps.

    Args:
        scene: built-in name, ``procedural:SEED``, path of a scene file, or an :class:`Apartment`.
        tasks: the tasks that ``reset`` draws from; by default it samples new ones. A task passed in
            ``reset(options={"task": task})`` comes before both.
        end_on: ``stop``: the episode ends at the agent's stop, where success is evaluated; ``reach``: it ends on
            arrival and ``stop`` means nothing (for training only: it rewards a lost robot).
        goal: ``map``: the goal's (x, y) in the map; ``sensed``: its distance and bearing from the pose that the robot
            senses (:mod:`vssm_gym.envs.conventions.relative_goal`); ``true``: from the true pose.
        reward: ``dense`` (metres gained along free space, a cost a step, a success reward) or ``sparse`` (success).
        simulation: all further keywords: ``noise``, ``sensor_noise``, ``camera`` and the others of
            :class:`~vssm_gym.envs.simulation.Simulation`.
    """

    passes_to = Simulation
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        scene: Any = "oak",
        *,
        tasks: TaskSet | None = None,
        end_on: Literal["stop", "reach"] = "stop",
        goal: GoalForm = "map",
        reward: Literal["dense", "sparse"] = "dense",
        **simulation: Any,
    ) -> None:
        choose("PointNav", "end_on", end_on, ("stop", "reach"))
        choose("PointNav", "goal", goal, GOAL_FORMS)
        choose("PointNav", "reward", reward, ("dense", "sparse"))
        self.simulation = Simulation(scene, **simulation)
        self.end_on, self.goal, self.reward, self.robot = end_on, goal, reward, self.simulation.robot
        self.frames, self.render_mode = self.simulation.frames, self.simulation.frames.mode
        self.renderer_name = self.simulation.renderer.name
        self.parallel = self.simulation.parallel
        self.success_radius = SUCCESS * self.robot.body_length
        self._adopt()
        if names := self.sampler.space.cut_off_rooms():
            kept = "tasks are drawn from the largest connected part"
            message = f"{self.apartment.name}: cut off from the rest: {', '.join(names)}; {kept}"
            warnings.warn(message, SceneWarning, stacklevel=2)
        self.tasks = None if tasks is None else checked_set("PointNav", tasks, self.apartment)
        if tasks is not None and self.simulation.scenes > 1:
            raise InputError("PointNav", "tasks", "no tasks of one scene where the scene varies")
        self.action_space = self.simulation.action_space(stops=end_on == "stop")
        point = gym.spaces.Box(-MAX_COORDINATE, MAX_COORDINATE, (2,), np.float32)
        self.simulation.sensors.add(TaskObservation("goal", point, self._goal))
        seen = gym.spaces.Dict(self.simulation.sensors.spaces())
        self.observation_space = seen if goal == "map" else with_relative_goal(seen)

        self.task: Task | None = None
        self._to_goal = np.inf  # m along free space
        self._reckons = goal == "sensed" and is_reckoned(seen)
        self._start = self._reckoned = np.zeros(3)  # the pose at the start, and that after the commands so far
        self._outcome: tuple[float, bool, dict[str, Any]] = (0.0, False, {})  # reward, terminated, info

    @property
    def planar(self) -> PlanarPose:
        """Return the true ``(x, y, heading)``, m and rad; not for agents."""
        return self.simulation.planar

    @property
    def path_length(self) -> float:
        """Return the metres driven in this episode."""
        return self.simulation.path_length

    def begin(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start ``options["task"]``, or a task of the seeded task stream.

        A seed restarts all streams; without one they continue. Raises :class:`InputError` where the task does not
        belong to this scene, or where its start or goal is not free.
        """
        task = check_options(options, "task").get("task")
        self.simulation.seed(seed)
        if self.simulation.vary():
            self._adopt()
        self.task = self._next_task() if task is None else self._checked(task)
        start = np.asarray(self.task.start, dtype=np.float64)
        self.simulation.place(start)
        self._start = self._reckoned = start
        self._goal_distance.aim(np.asarray(self.task.goal))
        self._to_goal = self._goal_distance(self.planar[:2])
        info = self.simulation.info(self.simulation.rest, collision=False) | self._progress(False)
        self._outcome = 0.0, False, info | {"task": self.task, "start_pose": start}

    def advance(self, action: np.ndarray) -> None:
        """Carry out the robot's command and ``stop``, such as ``(turn, o, s, stop)``, clipped to its limits.

        A stop ends the episode without a motion.
        """
        assert self.task is not None
        command, stop = self.simulation.parse(action)
        stop &= self.end_on == "stop"
        if stop:
            command, collision = self.simulation.rest, False
        else:
            collision = self.simulation.drive(command)
        if self._reckons:
            self._reckoned = reckoned(self._reckoned, command, self.robot)
        arrived = bool(np.hypot(*(self.planar[:2] - self.task.goal)) <= self.success_radius)
        terminated = stop if self.end_on == "stop" else arrived
        reward = self._reward(terminated and arrived)
        info = self.simulation.info(command, collision) | self._progress(terminated and arrived)
        self._outcome = reward, terminated, info

    def sense(self) -> None:
        """Take the image."""
        self.simulation.sense()

    def report(self) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated (always False: a wrapper counts steps) and info."""
        assert self.task is not None
        reward, terminated, info = self._outcome
        observation = self.simulation.observation()
        if self.goal != "map" and "goal" in observation:  # ImageNav removes it
            sensed = self.goal == "sensed"
            pose = sensed_pose(observation, self._start, self._reckoned) if sensed else self.planar
            observation = relative_goal(observation, pose)
        return observation, reward, terminated, False, info

    def panels(self) -> list[Panel]:
        """Return the camera's image and the plan with the path so far, 360 pixels high."""
        assert self.task is not None
        return self.simulation.panels(np.asarray(self.task.goal), self.success_radius)

    def captions(self) -> list[Caption]:
        """Return the straight distance to the goal."""
        assert self.task is not None
        return [Caption("goal", f"{np.hypot(*(self.planar[:2] - self.task.goal)):.2f} m")]

    def _adopt(self) -> None:
        """Take scene, camera and noise of the simulation, which may vary from episode to episode."""
        simulation = self.simulation
        self.apartment, self.camera, self.noise = simulation.apartment, simulation.camera, simulation.noise
        self.sampler = simulation.scene_cache.sampler
        self._goal_distance = simulation.scene_cache.goal_distance()

    def _goal(self) -> np.ndarray:
        """Return the goal, as observed."""
        assert self.task is not None
        return np.asarray(self.task.goal, dtype=np.float32)

    def _next_task(self) -> Task:
        stream = self.simulation.streams["task"]
        if self.tasks is None:
            return self.sampler.draw(stream)
        return self.tasks.tasks[stream.integers(len(self.tasks.tasks))]

    def _checked(self, task: Any) -> Task:
        if not isinstance(task, Task):
            raise InputError("reset", "options['task']", f"a Task; found {type(task).__name__}")
        self.sampler.validate(task)
        return task

    def _progress(self, success: bool) -> dict[str, Any]:
        """Return the entries of ``info`` about the task; ``spl`` is eq. T31 of this episode, 0 until its success."""
        assert self.task is not None
        driven, shortest = self.path_length, self.task.geodesic
        efficiency = 1.0 if driven <= shortest else shortest / driven
        spl = efficiency if success else 0.0
        return {"distance_to_goal": self._to_goal, "path_length": driven, "success": success, "spl": spl}

    def _reward(self, success: bool) -> float:
        """Update the distance to the goal, and return the reward of this step."""
        prize = POINTNAV_REWARD.success if success else 0.0
        now = self._goal_distance(self.planar[:2])
        # Squeezed between obstacles a robot may be off the grid of free positions: it gains nothing until it is back.
        gained = self._to_goal - now if np.isfinite(now) and np.isfinite(self._to_goal) else 0.0
        self._to_goal = now if np.isfinite(now) else self._to_goal
        return prize if self.reward == "sparse" else gained - POINTNAV_REWARD.step_cost + prize
