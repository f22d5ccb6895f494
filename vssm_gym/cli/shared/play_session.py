"""Play episodes by keys: the session behind ``vssm-gym play``, without a terminal."""

import contextlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.data.recording import recorded_episode
from vssm_gym.envs.rendering.topdown import TopDown
from vssm_gym.viz.terminal import Colours, depth_picture, side_by_side

PLAN = 64  # pixels, edge of the plan before it is fitted into the terminal
TEXT_LINES = 5  # under the pictures
ALIASES = {"up": "w", "left": "a", "right": "d", "down": "s"}
COMMON = "r new task   p plan   q quit"
BOLD, PLAIN = "\x1b[1m", "\x1b[0m"


@dataclass(frozen=True)
class KeyBindings:
    """Map keys to actions: ``proportions[key]`` of each bound, from -1 (low) to 1 (high); ``help`` is shown."""

    proportions: dict[str, tuple[float, ...]]
    help: str
    scene: str = "oak"  # default
    camera: bool = True  # the robot has a camera, whose images can be recorded

    def action(self, key: str, space: Any) -> np.ndarray:
        """Return the action of a key within the box ``space``."""
        proportion = np.array(self.proportions[key])
        return np.where(proportion >= 0.0, proportion * space.high, -proportion * space.low).astype(np.float32)


# (turn, o, s, stop): turns, straight on, curves; the robot has no reverse.
HOLONOMIC = KeyBindings(
    {
        "w": (0.0, 0.0, 1.0, 0.0),
        "a": (1.0, 0.0, 0.0, 0.0),
        "d": (-1.0, 0.0, 0.0, 0.0),
        "z": (1.0, 0.0, 1.0, 0.0),
        "c": (-1.0, 0.0, 1.0, 0.0),
        "s": (0.0, 0.0, 0.0, 0.0),
        "space": (0.0, 0.0, 0.0, 1.0),
    },
    "w ↑ ahead   a ← d → turn   z c curve   s ↓ wait   space I am there",
)

# (turn, s, stop) in a maze: the same keys
MAZE = KeyBindings(
    {key: (turn, step, stop) for key, (turn, _, step, stop) in HOLONOMIC.proportions.items()},
    HOLONOMIC.help,
    scene="rooms-v1",
    camera=False,
)

PLAYABLE: dict[str, KeyBindings] = {
    "PointNav-v0": HOLONOMIC,
    "ImageNav-v0": HOLONOMIC,
    "Explore-v0": HOLONOMIC,
    "LidarMaze-v0": MAZE,
}
"""The environments that one key per step can steer, by id without ``vssm_gym/``."""


class Session:
    """Run episodes driven by keys; ``left`` is True after the key that quits.

    Args:
        env: a robot on the floor of an apartment, or in a maze and with pictures (``render_mode="rgb_array"``).
        keys: its keys.
        title: title of the screen.
        record: folder for a recording of each episode (1, 2, ...), or None.
        about: metadata of each recording.
        seed: seed of the first episode; later ones continue its streams.
    """

    def __init__(
        self, env: gym.Env, keys: KeyBindings, title: str, record: Path | None, about: dict[str, Any], seed: int
    ) -> None:
        self.env, self.keys, self.title = env, keys, title
        self.plan = self.left = False
        self.episodes = self.successes = 0
        self._record, self._about = record, about
        self._recording = contextlib.ExitStack()
        self._world: Any = env.unwrapped
        self._plan: TopDown | None = None
        self._begin(seed)

    def _begin(self, seed: int | None = None) -> None:
        self.close()
        self.observation, self.info = self.env.reset(seed=seed)
        self._first = (self.observation, self.info)
        self._write: Callable[[Any, Any], None] | None = None
        self.episodes += 1
        self.steps = self.collisions = 0
        self.total, self.result = 0.0, ""
        self._path = [self._planar()[:2]]

    def press(self, key: str) -> None:
        """Handle a key; unknown keys do nothing, and an episode that has ended takes no more steps."""
        key = ALIASES.get(key, key)
        if key == "q":
            self.left = True
        elif key == "r":
            self._begin()
        elif key == "p":
            self.plan = not self.plan
        elif key in self.keys.proportions and not self.result:
            self._step(key)

    def _step(self, key: str) -> None:
        action = self.keys.action(key, self.env.action_space)
        self.observation, reward, terminated, truncated, self.info = self.env.step(action)
        self.steps += 1
        self._path.append(self._planar()[:2])
        self.collisions += bool(self.info["collision"])
        self.total += float(reward)
        if self._record is not None:
            if self._write is None:  # an episode without a step leaves no recording
                folder = self._record / str(self.episodes)
                recording = recorded_episode(self._world.simulation, folder, self._about)
                self._write = self._recording.enter_context(recording)
                self._write(*self._first)
            self._write(self.observation, self.info)
        if terminated:
            success = self.info.get("success")
            self.successes += bool(success)
            self.result = {True: "ARRIVED", False: "NOT THERE", None: "ENDED"}[success]
        elif truncated:
            self.result = "OUT OF TIME"

    def close(self) -> None:
        """Close the recording of the current episode."""
        self._recording.close()

    def screen(self, columns: int, rows: int, colours: Colours = "true") -> list[str]:
        """Return the lines for a terminal of this size: pictures, and the status under them."""
        images = [v for v in self.observation.values() if v.ndim == 3 and v.dtype == np.uint8]
        if "depth" in self.observation:
            images.append(depth_picture(self.observation["depth"]))
        if not self.keys.camera:
            images.append(np.asarray(self.env.render()))  # the plan with the readings of the scanner
        elif self.plan:
            images.append(self._plan_picture())
        lines = side_by_side(images, columns, max(1, rows - TEXT_LINES), colours)
        limit = f" of {self.env.spec.max_episode_steps}" if self.env.spec and self.env.spec.max_episode_steps else ""
        status = f"episode {self.episodes}   step {self.steps}{limit}   collisions {self.collisions}"
        if self.info["collision"]:
            status += f"   {BOLD}bump{PLAIN}"
        where = self._goal_line() if self._has_goal() else ""
        if "coverage" in self.info:
            where = f"seen {self.info['coverage']:.0%}   "
        result = f"   {BOLD}{self.result}{PLAIN}: r for a new task" if self.result else ""
        text = [
            f"{BOLD}{self.title}{PLAIN}",
            f"{where}reward {self.total:+.2f}{result}",
            status,
            self.keys.help,
            COMMON,
        ]
        return lines + text

    def _plan_picture(self) -> np.ndarray:
        """Return the floor plan with robot, path and goal, in so few pixels that the robot stays visible."""
        if self._plan is None:
            self._plan = TopDown(self._world.simulation.renderer.boxes, PLAN, PLAN)
        goal, radius = (self.observation["goal"], self._world.success_radius) if self._has_goal() else (None, 0.0)
        return self._plan.draw(np.array(self._path), self._planar(), self._world.simulation.robot.radius, goal, radius)

    def _planar(self) -> np.ndarray:
        """Return the true ``(x, y, heading)``, m and rad."""
        return self.info["pose"] if "pose" in self.info else planar_pose(self.info["T_world_cam"])

    def _has_goal(self) -> bool:
        return np.shape(self.observation.get("goal")) == (2,)

    def _goal_line(self) -> str:
        """Return the true direction and distance of the goal, which agents do not get."""
        distance, bearing = goal_ahead(self._planar(), self.observation["goal"])
        side = "left" if bearing >= 0.0 else "right"
        return f"goal {arrow(bearing)} {distance:.2f} m, {abs(math.degrees(bearing)):.0f}° {side}   "

    def summary(self) -> list[str]:
        """Return the lines that are printed at the end."""
        lines = [f"{self.episodes} episode{'s' * (self.episodes > 1)}, {self.successes} with success"]
        if self._record is not None and self._record.exists():
            episodes = (path for path in self._record.iterdir() if path.name.isdigit())
            folders = sorted(episodes, key=lambda path: int(path.name))
            lines += [f"recorded: {folder}" for folder in folders]
        return lines


def planar_pose(T_world_cam: np.ndarray) -> np.ndarray:
    """Return ``(x, y, heading)`` of a camera that looks along the floor: position, and direction of its z axis."""
    return np.array([*T_world_cam[:2, 3], math.atan2(T_world_cam[1, 2], T_world_cam[0, 2])])


def goal_ahead(planar: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    """Return distance (m) and bearing (rad, left positive, in (-pi, pi]) of ``goal (2,)`` from ``(x, y, heading)``."""
    away = np.asarray(goal, dtype=np.float64) - planar[:2]
    ahead = np.array([math.cos(planar[2]), math.sin(planar[2])])
    cross, dot = ahead[0] * away[1] - ahead[1] * away[0], float(ahead @ away)
    return float(np.hypot(*away)), math.atan2(cross, dot)


def arrow(bearing: float) -> str:
    """Return one of eight arrows; up is straight ahead."""
    return "↑↖←↙↓↘→↗"[round(bearing / (math.pi / 4)) % 8]
