"""PointNav: a noisy holonomic robot with an RGB-D camera drives to a point of a furnished apartment (SPEC 6).

The robot is told its start and its goal, then sees images only. It acts ``(turn, o, s, stop)`` at 5 Hz, strays from
every command by seeded noise, collides with walls and furniture, and says itself when it has arrived. The tables of
observation, action, reward and termination are in ``docs/envs/pointnav.md``.
"""

import warnings
from typing import Any, Literal

import gymnasium as gym
import numpy as np

from vssm_gym.axes import PlanarPose
from vssm_gym.envs.mjcf import World
from vssm_gym.envs.progress import GoalDistance
from vssm_gym.envs.robots import ExecutionNoise, HolonomicRobot, execute, execution_noise
from vssm_gym.envs.scene import Apartment, load_scene
from vssm_gym.envs.sensors import CameraConfig, raycast_camera
from vssm_gym.envs.tasks import SUCCESS, Task, TaskSampler, TaskSet
from vssm_gym.envs.topdown import TopDown
from vssm_gym.errors import InputError
from vssm_gym.geometry import planar_to_matrix

STREAMS = ("scene", "task", "dynamics", "sensors")  # one generator each, so that one's use never shifts another's
EXTENT = 1000.0  # m, bound of depths and coordinates: the same for all scenes, so that a policy fits each
STEP_COST, SUCCESS_REWARD = 0.01, 2.5
PICTURE = 360  # pixels, height of a rendered picture and width of its plan


class PointNavEnv(gym.Env[dict[str, Any], np.ndarray]):
    """One apartment, one robot; see the module. Registered as ``vssm_gym/PointNav-v0``, truncated after 500 steps.

    Args:
        scene: built-in name, path of a file that `load_scene` reads, or an :class:`Apartment`.
        noise: how motion strays from commands: ``none``, ``low``, ``mid``, ``high`` or an :class:`ExecutionNoise`.
        sensor_noise: ``none``: images are exact.
        camera: size and angle of the images.
        renderer: ``raycast``. What traced the rays is in ``renderer_name``, to be recorded with results.
        physics: ``mujoco``.
        observe_pose: whether the observation holds the true pose (an oracle's privilege).
        tasks: the tasks that ``reset`` draws from; by default it samples new ones. A task passed in
            ``reset(options={"task": task})`` comes before both.
        end_on: ``stop``: the episode ends when the agent says so, and success is judged there; ``reach``: it ends on
            arrival and ``stop`` means nothing (for training only: it rewards a lost robot).
        reward: ``dense`` (metres gained along free space, a cost a step, a prize for success) or ``sparse`` (success).
        render_mode: ``rgb_array`` or None.
        threads: threads that share the rendering of an image; by default two where there are two cores.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 5}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        scene: Any = "oak",
        noise: str | ExecutionNoise = "low",
        sensor_noise: str = "none",
        camera: CameraConfig | None = None,
        renderer: str = "raycast",
        physics: str = "mujoco",
        observe_pose: bool = False,
        tasks: TaskSet | None = None,
        end_on: Literal["stop", "reach"] = "stop",
        reward: Literal["dense", "sparse"] = "dense",
        render_mode: str | None = None,
        threads: int | None = None,
    ) -> None:
        _choose("sensor_noise", sensor_noise, ("none",))
        _choose("renderer", renderer, ("raycast",))
        _choose("physics", physics, ("mujoco",))
        _choose("end_on", end_on, ("stop", "reach"))
        _choose("reward", reward, ("dense", "sparse"))
        _choose("render_mode", render_mode, (None, "rgb_array"))
        config = CameraConfig() if camera is None else camera
        if not isinstance(config, CameraConfig):
            raise InputError("PointNav", "camera", f"a CameraConfig; found {camera!r}")
        self.noise = execution_noise(noise)
        self.observe_pose, self.end_on, self.reward, self.render_mode = observe_pose, end_on, reward, render_mode
        self.apartment: Apartment = load_scene(scene)
        self.robot = HolonomicRobot()
        self.success_radius = SUCCESS * self.robot.body_length
        self._sampler = TaskSampler(self.apartment, self.robot)
        if names := self._sampler.space.cut_off_rooms():
            kept = "tasks are drawn from the largest connected part"
            warnings.warn(f"{self.apartment.name}: cut off from the rest: {', '.join(names)}; {kept}", stacklevel=2)
        self.world = World(self.apartment, self.robot)
        self._eye = raycast_camera(self.world, config, threads)
        self.camera = self._eye.camera
        self.renderer_name = self._eye.tracer.name
        self.tasks = None if tasks is None else self._checked_set(tasks)
        self._goal_distance = GoalDistance(self._sampler.space) if reward == "dense" else None
        self._K = self.camera.K

        turn, offset, step = self.robot.limits
        low, high = [-turn, -offset, 0.0, 0.0], [turn, offset, step, 1.0]
        self.action_space = gym.spaces.Box(np.array(low, np.float32), np.array(high, np.float32))
        size = (self.camera.height, self.camera.width)
        spaces: dict[str, gym.Space[Any]] = {
            "rgb": gym.spaces.Box(0, 255, (*size, 3), np.uint8),
            "depth": gym.spaces.Box(0.0, EXTENT, size, np.float32),
            "goal": gym.spaces.Box(-EXTENT, EXTENT, (2,), np.float32),
        }
        if observe_pose:
            far = np.array([EXTENT, EXTENT, np.pi], np.float32)
            spaces["pose"] = gym.spaces.Box(-far, far)
        self.observation_space = gym.spaces.Dict(spaces)

        self._streams: dict[str, np.random.Generator] = {}
        self.task: Task | None = None
        self.path_length = 0.0  # m driven in this episode
        self._path: list[np.ndarray] = []
        self._to_goal = np.inf  # m along free space, dense reward only
        self._plan: TopDown | None = None
        self._image: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def planar(self) -> PlanarPose:
        """The true ``(x, y, heading)``, m and rad; not for agents."""
        return self.world.pose()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start ``options["task"]``, or a task of the seeded task stream.

        A seed restarts all streams; without one they go on. Raises :class:`InputError` where the task does not belong
        to this scene, or where its start or goal is not free.
        """
        super().reset(seed=seed)
        if seed is not None or not self._streams:
            children = np.random.SeedSequence(seed).spawn(len(STREAMS))
            self._streams = {name: np.random.default_rng(child) for name, child in zip(STREAMS, children, strict=True)}
        unknown = set(options or {}) - {"task"}
        if unknown:
            raise InputError("reset", "options", f"no other key than 'task'; found {sorted(unknown)}")
        task = (options or {}).get("task")
        self.task = self._next_task() if task is None else self._checked(task)
        start = np.asarray(self.task.start, dtype=np.float64)
        self.world.reset(start)
        self.path_length, self._path = 0.0, [self.planar[:2]]
        if self._goal_distance is not None:
            self._goal_distance.aim(np.asarray(self.task.goal))
            self._to_goal = self._goal_distance(self.planar[:2])
        self._image = None
        info = self._info(np.zeros(3), collision=False)
        info |= {"task": self.task, "start_pose": start}
        return self._observe(info["T_world_cam"]), info

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Carry out ``(turn, o, s, stop)``; what exceeds the limits is clipped to them.

        A stop ends the episode where the robot stands: nothing else of the action is carried out.
        """
        if self.task is None:
            raise gym.error.ResetNeeded("call reset before step")
        command, stop = self._command(action)
        if stop:
            command, collision = np.zeros(3), False
        else:
            before = self.planar
            collision = self.world.drive(execute(before, command, self.noise, self._streams["dynamics"]))
            self.path_length += float(np.hypot(*(self.planar - before)[:2]))
            self._path.append(self.planar[:2])
            self._image = None
        arrived = bool(np.hypot(*(self.planar[:2] - self.task.goal)) <= self.success_radius)
        terminated = stop if self.end_on == "stop" else arrived
        info = self._info(command, collision)
        if terminated:
            info["success"] = arrived
        return self._observe(info["T_world_cam"]), self._reward(terminated and arrived), terminated, False, info

    def render(self) -> np.ndarray | None:
        """The camera's image beside the plan with the path so far: uint8 ``(360, width, 3)``."""
        if self.render_mode is None or self.task is None:
            return None
        if self._plan is None:
            self._plan = TopDown(self.world.boxes, PICTURE, PICTURE)
        rgb, _ = self._see(self._info(np.zeros(3), collision=False)["T_world_cam"])
        # Nearest pixels: the picture shows what the agent sees.
        rows = (np.arange(PICTURE) * rgb.shape[0]) // PICTURE
        columns = (np.arange(PICTURE * rgb.shape[1] // rgb.shape[0]) * rgb.shape[0]) // PICTURE
        goal = np.asarray(self.task.goal)
        plan = self._plan.draw(np.array(self._path), self.planar, self.robot.radius, goal, self.success_radius)
        return np.concatenate([rgb[rows[:, None], columns[None]], plan], axis=1)

    def close(self) -> None:
        """Let go of the rendering threads."""
        self._eye.close()

    def _next_task(self) -> Task:
        if self.tasks is None:
            return self._sampler.draw(self._streams["task"])
        return self.tasks.tasks[self._streams["task"].integers(len(self.tasks.tasks))]

    def _checked_set(self, tasks: Any) -> TaskSet:
        if not isinstance(tasks, TaskSet) or not tasks.tasks:
            raise InputError("PointNav", "tasks", f"a TaskSet that holds a task; found {tasks!r:.80}")
        if tasks.scene_hash != self.apartment.content_hash():
            raise InputError("tasks", "scene_hash", f"tasks of this version of {self.apartment.name!r}")
        return tasks

    def _checked(self, task: Any) -> Task:
        if not isinstance(task, Task):
            raise InputError("reset", "options['task']", f"a Task; found {type(task).__name__}")
        self._sampler.validate(task)
        return task

    def _command(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        try:
            values = np.asarray(action)
        except ValueError:  # a ragged list
            raise InputError("step", "action", f"four numbers (turn, o, s, stop); found {action!r:.80}") from None
        if values.shape != (4,) or values.dtype.kind not in "fiu":
            found = f"found shape {values.shape}, type {values.dtype}"
            raise InputError("step", "action", f"four numbers (turn, o, s, stop); {found}")
        if not np.isfinite(values).all():
            raise InputError("step", "action", f"finite numbers (turn, o, s, stop); found {values.tolist()}")
        return self.robot.clip(values[:3]), bool(values[3] > 0.5) and self.end_on == "stop"

    def _info(self, command: np.ndarray, collision: bool) -> dict[str, Any]:
        T_world_cam = planar_to_matrix(self.planar) @ self.robot.T_body_cam
        return {"T_world_cam": T_world_cam, "K": self._K.copy(), "collision": collision, "control": command}

    def _see(self, T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The image at the robot's pose, traced once however often it is asked for."""
        if self._image is None:
            self._image = self._eye.render(T_world_cam)
        return self._image

    def _observe(self, T_world_cam: np.ndarray) -> dict[str, np.ndarray]:
        assert self.task is not None
        rgb, depth = self._see(T_world_cam)
        observation = {"rgb": rgb.copy(), "depth": depth.copy(), "goal": np.asarray(self.task.goal, dtype=np.float32)}
        if self.observe_pose:
            observation["pose"] = self.planar.astype(np.float32)
        return observation

    def _reward(self, success: bool) -> float:
        prize = SUCCESS_REWARD if success else 0.0
        if self._goal_distance is None:
            return prize
        now = self._goal_distance(self.planar[:2])
        # Squeezed between obstacles a robot may be off the grid of free positions: it gains nothing until it is back.
        gained = self._to_goal - now if np.isfinite(now) and np.isfinite(self._to_goal) else 0.0
        self._to_goal = now if np.isfinite(now) else self._to_goal
        return gained - STEP_COST + prize


def _choose(field: str, value: Any, available: tuple[Any, ...]) -> None:
    if value not in available:
        names = ", ".join(map(repr, available))
        raise InputError("PointNav", field, f"one of {names}; found {value!r}")
