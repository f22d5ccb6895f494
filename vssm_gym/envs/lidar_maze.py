"""Define LidarMaze: a noisy disc with a laser scanner, or a camera, drives through a maze of the unit square.

The plane has no physics beyond contact, so no simulator is needed: rays and sliding discs are solved exactly
(:mod:`vssm_gym.envs.physics.planar`). The robot acts ``(turn, s, stop)`` with seeded execution noise, and observes
ranges only, or one row of pixels all around. The tables of observation, action, reward and termination are in
``docs/envs/lidar_maze.md``.
"""

import math
from pathlib import Path
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from PIL import Image, ImageDraw

from vssm_gym.envs.maze_noise import motion_noise, range_noise, strip_noise
from vssm_gym.envs.phased import PhasedEnv
from vssm_gym.envs.physics.planar import clearance, scan, slide
from vssm_gym.envs.rendering.captions import Caption, Panel
from vssm_gym.envs.rendering.frames import Frames
from vssm_gym.envs.rendering.maze_paint import painted
from vssm_gym.envs.rendering.topdown import PLAN_LEGEND, TopDown
from vssm_gym.envs.robots import ExecutionNoise, execute
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.sensors.base import HasPlanar, Sensor
from vssm_gym.envs.sensors.lidar import LidarConfig, LidarNoise
from vssm_gym.envs.sensors.maze_scan import MazeScan
from vssm_gym.envs.sensors.maze_strip import MazeStrip, StripNoise
from vssm_gym.envs.sensors.pose import PoseSensor
from vssm_gym.envs.sensors.suite import SensorSuite
from vssm_gym.envs.sensors.task_observation import TaskObservation
from vssm_gym.envs.streams import STREAMS, seeded_streams
from vssm_gym.envs.tasks.maze_objectives import Approach, MazeCoverage
from vssm_gym.envs.tasks.mazes import ROBOT, load_maze
from vssm_gym.envs.tasks.navigation import SUCCESS, Task, TaskSet, checked_set
from vssm_gym.envs.tasks.rewards import DenseReward
from vssm_gym.envs.validation import check_options, choose, parse_action
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose

LONGEST_RANGE = 1.5  # m, upper bound of a reading: no wall of the unit square is farther than sqrt(2)
MAZE_REWARD = DenseReward(step_cost=0.001, success=1.0)  # in metres gained, or in tiles visited
MAZE_PICTURE = 480  # pixels, height and width of a rendered picture
_RAY = (236, 140, 40)  # RGB of the scan's points
_RING, _RING_WIDTH = 0.06, 8  # m from the robot, and pixels: the strip's ring


class LidarMazeEnv(PhasedEnv):
    """Simulate one robot in one maze. Registered as ``vssm_gym/LidarMaze-v0``, truncated after 1000 steps.

    Args:
        scene: name of a built-in maze, path of a maze in our JSON format, or an :class:`Apartment` of the unit square.
        noise: execution noise: ``none``, ``low``, ``mid``, ``high`` or an :class:`ExecutionNoise`.
        sensor_noise: errors of ranges or of pixels: the same names, or a :class:`LidarNoise` or :class:`StripNoise`.
        beams: readings in a scan of a full circle, or columns of a strip.
        observe_pose: if True, the observation holds the true pose (an oracle's privilege).
        task: ``navigate`` to a goal, or ``explore``: visit every tile.
        tasks: the tasks that ``reset`` draws from; by default all pairs of the maze's 5 x 5 grid. ``explore`` takes
            their starts. A task passed in ``reset(options={"task": task})`` comes before both.
        end_on: ``stop``: the episode ends at the agent's stop, where success is evaluated; ``reach``: it ends when the
            task is done and ``stop`` means nothing.
        goal: how it is observed: its ``position``, or the ``scan`` that the robot's own scanner would take there,
            without noise, with a heading that the task fixes.
        reward: ``dense`` (metres gained, a cost a step, a success reward) or ``sparse`` (success).
        render_mode: ``rgb_array``, ``human`` (a window) or None.
        captions: if True, a strip of text lies below each picture; a window always shows it.
        sensor: ``lidar``, which measures ``scan``, or ``camera``, which sees ``strip``.
        wall_offset: m that every wall is thicker on each side; below 0 thinner.
    """

    parallel = True
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        scene: str | Path | Apartment = "rooms-v1",
        noise: str | ExecutionNoise = "low",
        sensor_noise: str | LidarNoise | StripNoise = "none",
        beams: int = 64,
        observe_pose: bool = False,
        task: Literal["navigate", "explore"] = "navigate",
        tasks: TaskSet | None = None,
        end_on: Literal["stop", "reach"] = "stop",
        goal: Literal["position", "scan"] = "position",
        reward: Literal["dense", "sparse"] = "dense",
        render_mode: str | None = None,
        captions: bool = False,
        sensor: Literal["lidar", "camera"] = "lidar",
        wall_offset: float = 0.0,
    ) -> None:
        choose("LidarMaze", "sensor", sensor, ("lidar", "camera"))
        choose("LidarMaze", "task", task, ("navigate", "explore"))
        choose("LidarMaze", "goal", goal, ("position", "scan"))
        choose("LidarMaze", "end_on", end_on, ("stop", "reach"))
        choose("LidarMaze", "reward", reward, ("dense", "sparse"))
        if isinstance(beams, bool) or not isinstance(beams, int) or not 1 <= beams <= 4096:
            raise InputError("LidarMaze", "beams", f"1 to 4096 readings a scan, not {beams!r}")
        self.noise = motion_noise(noise)
        self.frames, self.render_mode = Frames("LidarMaze", render_mode, captions), render_mode
        self.end_on, self.reward = end_on, reward
        self.maze = load_maze(scene, wall_offset)
        self.robot, self.beams = ROBOT, beams
        self.success_radius = SUCCESS * self.robot.body_length
        self.tasks = self.maze.tasks if tasks is None else checked_set("LidarMaze", tasks, self.maze.apartment)
        self.objective: Approach | MazeCoverage = MazeCoverage(self.maze.space)
        if task == "navigate":
            dense = reward == "dense"
            self.objective = Approach(self.maze.space, self.robot.body_length, self.success_radius, dense)

        turn, _, step = self.robot.limits
        self.action_space = gym.spaces.Box(
            np.array([-turn, 0.0, 0.0], np.float32), np.array([turn, step, 1.0], np.float32)
        )
        self.sensor = sensor
        sensors: list[Sensor[HasPlanar]] = [self._eye(sensor_noise)]
        if task == "navigate" and goal == "scan":
            space = gym.spaces.Box(0.0, LONGEST_RANGE, (beams,), np.float32)
            sensors.append(TaskObservation("goal_scan", space, self._goal_scan))
        elif task == "navigate":
            sensors.append(TaskObservation("goal", gym.spaces.Box(0.0, 1.0, (2,), np.float32), self._goal))
        if observe_pose:
            sensors.append(PoseSensor(np.array([[0.0, 0.0, -np.pi], [1.0, 1.0, np.pi]])))
        self.sensors = SensorSuite("LidarMaze", sensors)
        self.observation_space = gym.spaces.Dict(self.sensors.spaces())

        self._streams: dict[str, np.random.Generator] = {}
        self.task: Task | None = None
        self.planar: PlanarPose = np.zeros(3)  # the true (x, y, heading), m and rad; not for agents
        self.path_length = 0.0  # m driven in this episode
        self._path: list[np.ndarray] = []
        self._outcome: tuple[float, bool, dict[str, Any]] = 0.0, False, {}
        self._plan: TopDown | None = None

    def begin(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start an episode: streams, task and pose, without a scan."""
        task = check_options(options, "task").get("task")
        if seed is not None or not self._streams:
            self._streams = seeded_streams(seed, (*STREAMS, *self.sensors.streams))
            self.sensors.seed(self._streams)
        if task is None:
            task = self.tasks.tasks[self._streams["task"].integers(len(self.tasks.tasks))]
        else:
            self._check(task)
        self.task = task
        self.planar = np.array(self.task.start, dtype=np.float64)
        self.path_length, self._path = 0.0, [self.planar[:2]]
        self.sensors.begin(self)
        self.objective.begin(self.task)
        info = self._info(np.zeros(2), collision=False) | {"task": self.task, "start_pose": self.planar.copy()}
        self._outcome = 0.0, False, info

    def advance(self, action: np.ndarray) -> None:
        """Move the robot, and compute reward and termination."""
        assert self.task is not None
        command, stop = self._command(action)
        collision = False
        self.sensors.moved()
        if stop:
            command = np.zeros(2)
        else:
            collision = self._drive(command)
        gained = self.objective.gained(self.planar[:2])
        reached = self.objective.reached(self.planar[:2])
        terminated = stop if self.end_on == "stop" else reached
        reward = MAZE_REWARD.success if terminated and reached else 0.0
        if self.reward == "dense":
            reward += gained - MAZE_REWARD.step_cost
        info = self._info(command, collision)
        if terminated:
            info["success"] = reached
        self._outcome = reward, terminated, info

    def sense(self) -> None:
        """Let the sensors measure at the robot's pose, once however often it is called."""
        self.sensors.sense(self)

    def report(self) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info of the last reset or step."""
        assert self.task is not None
        reward, terminated, info = self._outcome
        return self.sensors.observation(), reward, terminated, False, info

    def panels(self) -> list[Panel]:
        """Return the plan with path, robot, goal region and what the sensor sees from the true pose: ``(480, 480, 3)``.

        A scan is points; a strip is a ring around the robot, whose colours lie in the directions of its columns.
        """
        assert self.task is not None
        if self._plan is None:
            self._plan = TopDown(self.maze.apartment.boxes(), MAZE_PICTURE, MAZE_PICTURE, margin=0.02)
        goal = np.asarray(self.task.goal) if isinstance(self.objective, Approach) else None
        picture = self._plan.draw(np.array(self._path), self.planar, self.robot.radius, goal, self.success_radius)
        image = Image.fromarray(picture)
        legend = {name: colour for name, colour in PLAN_LEGEND.items() if name != "goal" or goal is not None}
        self.sense()
        angle = self.planar[2] + 2.0 * np.pi * np.arange(self.beams) / self.beams
        pen = ImageDraw.Draw(image)
        if self.sensor == "camera":
            self._draw_strip(pen, angle)
            return [Panel(np.asarray(image), "plan", legend)]
        ranges = self.sensors.reading("scan")
        ends = self.planar[:2] + ranges[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        for column, row in self._plan.pixels(ends[ranges > 0.0]):
            pen.ellipse((column - 2.0, row - 2.0, column + 2.0, row + 2.0), fill=_RAY)
        return [Panel(np.asarray(image), "plan", legend | {"scan": _RAY})]

    def captions(self) -> list[Caption]:
        """Return the straight distance to the goal, or the share of tiles visited."""
        assert self.task is not None
        if isinstance(self.objective, MazeCoverage):
            return [Caption("coverage", f"{self.objective.ratio:.1%}")]
        return [Caption("goal", f"{math.hypot(*(self.planar[:2] - self.task.goal)):.2f} m")]

    def _draw_strip(self, pen: ImageDraw.ImageDraw, angle: np.ndarray) -> None:
        """Draw the strip's columns, which look along ``angle`` (rad), as a ring around the robot."""
        assert self._plan is not None
        half = 180.0 / self.beams
        (left, top), (right, bottom) = self._plan.pixels(self.planar[:2] + _RING * np.array([[-1.0, 1.0], [1.0, -1.0]]))
        for degrees, colour in zip(np.degrees(angle), self.sensors.reading("strip")[0].tolist(), strict=True):
            # Pillow's angles run clockwise.
            pen.arc((left, top, right, bottom), -degrees - half, -degrees + half, fill=tuple(colour), width=_RING_WIDTH)

    def _eye(self, noise: Any) -> MazeScan | MazeStrip:
        """Return the scanner, or the camera among painted walls."""
        if self.sensor == "camera":
            boxes = painted(self.maze.apartment.boxes(), self.maze.name)
            return MazeStrip(self.beams, boxes, self.robot.camera_height, strip_noise(noise))
        scanner = LidarConfig(beams=self.beams, max_range=LONGEST_RANGE, noise=range_noise(noise))
        return MazeScan(scanner, self.maze.rectangles)

    def _goal(self) -> np.ndarray:
        """Return the goal, as observed."""
        assert self.task is not None
        return np.asarray(self.task.goal, dtype=np.float32)

    def _goal_scan(self) -> np.ndarray:
        """Return the exact scan at the goal; its heading is drawn from the task."""
        assert self.task is not None
        drawn = np.random.default_rng([self.task.id, *np.frombuffer(np.array(self.task.goal).tobytes(), np.uint32)])
        pose = np.array([[*self.task.goal, drawn.uniform(-np.pi, np.pi)]])
        return np.minimum(scan(pose, self.maze.rectangles, self.beams)[0], LONGEST_RANGE).astype(np.float32)

    def _drive(self, command: np.ndarray) -> bool:
        """Execute a command with noise, sliding along walls; return True on collision."""
        turn, step = command
        wanted = execute(self.planar, np.array([turn, 0.0, step]), self.noise, self._streams["dynamics"])
        x, y = self.planar[:2]
        x, y, collided = slide(x, y, wanted[0] - x, wanted[1] - y, self.robot.radius, self.maze.rectangles)
        self.path_length += math.hypot(x - self.planar[0], y - self.planar[1])
        self.planar = np.array([x, y, wanted[2]])
        self._path.append(self.planar[:2])
        return collided

    def _check(self, task: Any) -> None:
        if not isinstance(task, Task):
            raise InputError("reset", "options['task']", f"a Task; found {type(task).__name__}")
        self.maze.sampler.validate(task)
        if clearance(*task.start[:2], self.maze.rectangles) < self.robot.radius:
            expected = "a position where the robot collides with no wall"
            raise InputError(f"task {task.id} of {task.scene}", "start", expected)

    def _command(self, action: np.ndarray) -> tuple[np.ndarray, bool]:
        values = parse_action(action, ("turn", "s", "stop"))
        turn, _, step = self.robot.clip(np.array([values[0], 0.0, values[1]]))
        return np.array([turn, step]), bool(values[2] > 0.5) and self.end_on == "stop"

    def _info(self, command: np.ndarray, collision: bool) -> dict[str, Any]:
        info = {"pose": self.planar.copy(), "collision": collision, "control": command}
        if isinstance(self.objective, MazeCoverage):
            info["coverage"] = self.objective.ratio
        return info
