"""Read and write the PointNav episode files of Habitat (``.json.gz``), as tasks of our scenes.

Habitat's world has y upwards, and its agent looks along -z; ours has z upwards, and its robot looks along x. The frames
differ by a quarter turn about x, whose origin is that of the scene:

    p_world = R_world_habitat p_habitat,    (x, y, z)_world = (x, -z, y)_habitat
    heading = angle + pi/2,                 q_habitat = (0, sin(angle / 2), 0, cos(angle / 2))   as x, y, z, w

since the direction -z, in which the agent looks at the angle 0 about y, is y in our world. A file keeps what it holds:
heights, ids, shortest paths and fields that are not known here come back as they were read.
"""

import gzip
import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks.navigation import Footprint, Task, TaskSampler, TaskSet
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.json_file import read_packed_json
from vssm_gym.files.numbers import floats
from vssm_gym.geometry.transforms import wrap_angle

HABITAT_BYTES = 64 << 20  # of a file of episodes, unpacked; 1000 episodes with their shortest paths have 2 MB
LARGEST_POSITION = 1e4  # m from the origin of a scene
UNIT = 1e-3  # that the norm of a quaternion may differ from 1
LARGEST_TILT = 1e-3  # that the x and z of a quaternion about the vertical may differ from 0
HEADING_DIGITS = 12  # to which a heading is rounded: what a quaternion of float64 resolves is two digits finer
LENGTH_DIGITS = 6  # to which the length of a shortest path is rounded, as in the frozen tasks


@dataclass(frozen=True)
class HabitatFile:
    """Hold the content of an episode file.

    Attributes:
        source: the file, for errors.
        content: the parsed JSON: ``episodes``, a list of objects, and whatever else the file holds.
    """

    source: str
    content: dict[str, Any]

    def scenes(self) -> dict[str, list[int]]:
        """Return the positions of each scene's episodes, by the ``scene_id`` as it is written."""
        found: dict[str, list[int]] = {}
        for position, episode in enumerate(self.content["episodes"]):
            found.setdefault(episode["scene_id"], []).append(position)
        return found

    def of_scene(self, name: str) -> list[int]:
        """Return the positions of the episodes of a scene.

        Args:
            name: a ``scene_id`` of the file, or a scene's name: that of the file that a ``scene_id`` names.

        Raises:
            InputError: the file has no episode of it.
        """
        scenes = self.scenes()
        found = scenes.get(name) or sorted(k for one, at in scenes.items() if short_name(one) == name for k in at)
        if not found:
            known = ", ".join(list(scenes)[:5]) + (", ..." if len(scenes) > 5 else "")
            raise InputError(self.source, "episodes.scene_id", f"an episode of scene {name!r}; it has those of {known}")
        return found

    def task_set(
        self, apartment: Apartment, robot: Robot, scene_id: str | None = None, most: int | None = None
    ) -> TaskSet:
        """Return the episodes of an apartment as tasks, which ``gym.make("vssm_gym/PointNav-v0", tasks=...)`` takes.

        The tasks are numbered in the order of the file. A task's ``geodesic`` is computed in our scene, as that of all
        our tasks; the file's distance, which Habitat measures to the goal itself on its own navigation mesh, is not
        used. Neither is a goal's ``radius``: the success radius is the robot's.

        Args:
            apartment: the scene.
            robot: that has to fit at start and goal.
            scene_id: of the episodes; None: those whose scene has the apartment's name.
            most: number of episodes to convert; None: all.

        Raises:
            InputError: no episode of the scene, or one whose start or goal the robot cannot stand at or reach.
        """
        chosen = self.of_scene(apartment.name if scene_id is None else scene_id)[:most]
        sampler = TaskSampler(apartment, robot)
        tasks = []
        for number, position in enumerate(chosen):
            start, goal = endpoints(self.content["episodes"][position])
            try:
                task = sampler.task(start, goal, number)
            except InputError as error:
                field = f"episodes[{position}].{error.field}"
                raise InputError(self.source, field, f"{error.expected} (in scene {apartment.name})") from error
            tasks.append(task.model_copy(update={"geodesic": round(task.geodesic, LENGTH_DIGITS)}))
        made = TaskSet(
            scene=apartment.name,
            scene_hash=apartment.content_hash(),
            robot=Footprint.of(robot),
            split="test",
            tasks=tuple(tasks),
        )
        return made.model_copy(update={"hash": made.content_hash()})

    def with_tasks(self, tasks: Sequence[Task], sampler: TaskSampler, scene_id: str | None = None) -> "HabitatFile":
        """Return this file with other tasks in the place of a scene's episodes.

        An episode whose start and goal are those of the task with its number stays as it is. In another one they are
        replaced, with the distance and without the shortest paths of the former ones; episodes beyond the tasks are
        left out, and tasks beyond the episodes are added at the end, numbered from the file's highest number on where
        theirs is taken. Episodes of other scenes stay.
        """
        positions = self.of_scene(sampler.scene if scene_id is None else scene_id)
        episodes: list[Any] = list(self.content["episodes"])
        name = episodes[positions[0]]["scene_id"]
        for number, task in enumerate(tasks):
            if number >= len(positions):
                taken = {str(episode["episode_id"]) for episode in episodes}
                added = episode_of(task, sampler, name)
                episodes.append(added if added["episode_id"] not in taken else added | {"episode_id": _unused(taken)})
                continue
            kept = episodes[positions[number]]
            if endpoints(kept) != (task.start, task.goal):
                episodes[positions[number]] = _moved(kept, episode_of(task, sampler, name))
        dropped = set(positions[len(tasks) :])
        kept_episodes = [episode for position, episode in enumerate(episodes) if position not in dropped]
        return HabitatFile(self.source, self.content | {"episodes": kept_episodes})


def _unused(taken: Collection[str]) -> str:
    """Return the number after the highest one of some texts."""
    return str(1 + max((int(one) for one in taken if one.isascii() and one.isdigit()), default=-1))


def read_habitat(path: str | Path) -> HabitatFile:
    """Read an episode file, packed if its name ends in ``.gz``.

    Raises:
        InputError: no such file, no JSON, or an episode without the fields of PointNav's schema: ``episode_id``,
            ``scene_id``, ``start_position`` (3), ``start_rotation`` (4: x, y, z, w, about the vertical) and one goal
            with a ``position`` (3).
    """
    content = read_packed_json(path, HABITAT_BYTES, "a readable file of PointNav episodes")
    if not isinstance(content, dict) or not isinstance(content.get("episodes"), list) or not content["episodes"]:
        raise InputError(path, "episodes", "a list of PointNav episodes, in an object")
    for position, episode in enumerate(content["episodes"]):
        _check(episode, path, f"episodes[{position}]")
    return HabitatFile(str(path), content)


def write_habitat(file: HabitatFile, path: str | Path) -> None:
    """Write an episode file, packed if its name ends in ``.gz``; it is complete or absent."""
    path = Path(path)
    text = json.dumps(file.content).encode()
    with atomic_write(path) as temporary:
        temporary.write_bytes(gzip.compress(text, mtime=0) if path.suffix == ".gz" else text)


def habitat_file(tasks: TaskSet, sampler: TaskSampler) -> HabitatFile:
    """Return the episode file of a task set; ``scene_id`` is the scene's name."""
    return HabitatFile("tasks", {"episodes": [episode_of(task, sampler, task.scene) for task in tasks.tasks]})


def episode_of(task: Task, sampler: TaskSampler, scene_id: str) -> dict[str, Any]:
    """Return a task as an episode: positions on the floor (y = 0), and the length of the shortest path to the goal."""
    start, goal = np.array(task.start[:2]), np.array(task.goal)
    length = sampler.geodesics.length(sampler.space.nearest(start), goal)
    return {
        "episode_id": str(task.id),
        "scene_id": scene_id,
        "start_position": to_habitat(task.start[:2]),
        "start_rotation": rotation_of(task.start[2]),
        "info": {"geodesic_distance": round(float(length), LENGTH_DIGITS)},
        "goals": [{"position": to_habitat(task.goal), "radius": sampler.success_radius}],
        "start_room": None,
        "shortest_paths": None,
    }


def endpoints(episode: dict[str, Any]) -> tuple[tuple[float, float, float], tuple[float, float]]:
    """Return start (x, y, heading) and goal (x, y) of an episode in our world, m and rad."""
    start, goal = from_habitat(episode["start_position"]), from_habitat(episode["goals"][0]["position"])
    return (*start, heading_of(episode["start_rotation"])), goal


def to_habitat(place: Sequence[float], height: float = 0.0) -> list[float]:
    """Return ``(x, y)`` of our floor at a height as Habitat's ``[x, y, z]``, m."""
    return [place[0], height, 0.0 - place[1]]  # 0.0 - 0.0 has no sign, as -0.0 has


def from_habitat(position: Sequence[float]) -> tuple[float, float]:
    """Return Habitat's ``[x, y, z]`` as ``(x, y)`` of our floor, m; the height is left out."""
    return float(position[0]), 0.0 - float(position[2])


def rotation_of(heading: float) -> list[float]:
    """Return the quaternion ``[x, y, z, w]`` of an agent with a heading (rad) of ours."""
    angle = float(wrap_angle(heading - np.pi / 2.0))
    return [0.0, float(np.sin(angle / 2.0)), 0.0, float(np.cos(angle / 2.0))]


def heading_of(rotation: Sequence[float]) -> float:
    """Return our heading (rad, in [-pi, pi)) of an agent with the quaternion ``[x, y, z, w]`` about the vertical."""
    angle = 2.0 * np.arctan2(rotation[1], rotation[3])
    return round(float(wrap_angle(angle + np.pi / 2.0)), HEADING_DIGITS)


def short_name(scene_id: str) -> str:
    """Return the name of the scene of a ``scene_id``: "Cantwell" of ``gibson/Cantwell.glb``."""
    return PurePosixPath(scene_id).name.split(".")[0]


def _moved(episode: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """Return an episode with start and goal of another one, at its own heights."""
    start, goal = list(new["start_position"]), list(new["goals"][0]["position"])
    start[1], goal[1] = episode["start_position"][1], episode["goals"][0]["position"][1]
    changed = episode | {"start_position": start, "start_rotation": new["start_rotation"]}
    changed["goals"] = [episode["goals"][0] | {"position": goal}]
    changed["info"] = (episode.get("info") or {}) | new["info"]
    if "shortest_paths" in episode:
        changed["shortest_paths"] = None
    return changed


def _check(episode: Any, path: str | Path, at: str) -> None:
    """Raise :class:`InputError` unless an episode has the fields that a task is made of."""
    if not isinstance(episode, dict):
        raise InputError(path, at, f"an episode as a JSON object; found {episode!r:.80}")
    number, scene = episode.get("episode_id"), episode.get("scene_id")
    if isinstance(number, bool) or not isinstance(number, str | int):
        raise InputError(path, f"{at}.episode_id", f"a text or a whole number; found {number!r:.80}")
    if not isinstance(scene, str) or not scene or not scene.isprintable():
        raise InputError(path, f"{at}.scene_id", f"a text of printable characters; found {scene!r:.80}")
    floats(episode.get("start_position"), (3,), path, f"{at}.start_position", largest=LARGEST_POSITION)
    x, y, z, w = floats(episode.get("start_rotation"), (4,), path, f"{at}.start_rotation", largest=1.0 + UNIT)
    if abs(np.sqrt(x * x + y * y + z * z + w * w) - 1.0) > UNIT or max(abs(x), abs(z)) > LARGEST_TILT:
        expected = "a unit quaternion x, y, z, w about the vertical, y"
        raise InputError(path, f"{at}.start_rotation", f"{expected}; found {episode['start_rotation']!r:.100}")
    goals = episode.get("goals")
    if not isinstance(goals, list) or len(goals) != 1 or not isinstance(goals[0], dict):
        raise InputError(path, f"{at}.goals", f"a list of one goal, with its position; found {goals!r:.80}")
    floats(goals[0].get("position"), (3,), path, f"{at}.goals[0].position", largest=LARGEST_POSITION)
    if episode.get("info") is not None and not isinstance(episode["info"], dict):
        raise InputError(path, f"{at}.info", f"an object, or null; found {episode['info']!r:.80}")
