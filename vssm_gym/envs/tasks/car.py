"""Sample and check tasks of the car: a start and a target, a point or a pose, that it can reach from there.

Starts and targets are uniform among the poses whose footprint keeps GOAL_MARGIN from everything, in one connected part
of what the car can reach (:mod:`vssm_gym.envs.tasks.car_space`), and more than TARGET_APART from each other. In a scene
with marked bays every target is the middle of one of them, either way.
"""

import copy
import math
import threading
import weakref
from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, get_args

import numpy as np
from jaxtyping import Float
from pydantic import Field

from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.generator.parking import BAY
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks.car_space import CarSpace
from vssm_gym.envs.tasks.goal_progress import GoalDistance
from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS, Car
from vssm_gym.geometry.transforms import wrap_angle

Targets = Literal["poses", "points"]
TARGETS: tuple[Targets, ...] = get_args(Targets)
TARGET_APART = 0.5  # m from start to target, more than
GOAL_MARGIN = 0.05  # m around the footprint at start and target
CAR_START_SLACK = 0.01  # m that a start may overlap obstacles: contacts give, and chains begin where they left it
_POSES_AT_ONCE, _ROUNDS = 256, 64  # poses drawn at once, and how often


class CarTask(StrictModel):
    """Drive from ``start`` to ``goal``: (x, y) or (x, y, heading) of the rear axle; world frame, metres and radians."""

    id: Annotated[int, Field(ge=0)] = 0
    scene: str
    start: tuple[float, float, float]
    goal: tuple[float, float] | tuple[float, float, float]

    def reached(self, planar: PlanarPose) -> bool:
        """Return True if a pose is within GOAL_RADIUS of the goal, and of its heading where it has one."""
        near = math.hypot(planar[0] - self.goal[0], planar[1] - self.goal[1]) <= GOAL_RADIUS
        return near and self.turn(planar) <= GOAL_HEADING_TOLERANCE

    def turn(self, planar: PlanarPose) -> float:
        """Return the angle between a pose's heading and the goal's, rad; 0 for a point."""
        return abs(float(wrap_angle(np.float64(planar[2] - self.goal[2])))) if len(self.goal) == 3 else 0.0


class CarTaskSampler:
    """Sample and check tasks of one apartment and car. Get it by :meth:`of`; it is immutable to its users."""

    _instances: ClassVar["weakref.WeakValueDictionary[tuple[str, Car], CarTaskSampler]"] = weakref.WeakValueDictionary()
    _lock: ClassVar = threading.Lock()

    def __init__(self, apartment: Apartment, car: Car) -> None:
        self.apartment, self.car = apartment, car
        self.space = CarSpace(apartment, car)

    @classmethod
    def of(cls, apartment: Apartment, car: Car) -> "CarTaskSampler":
        """Return the process's sampler of these two; it is built where there is none, in half a second."""
        key = (apartment.content_hash(), car)
        with cls._lock:
            sampler = cls._instances.get(key)
            if sampler is None:
                sampler = cls._instances[key] = cls(apartment, car)
        return sampler

    def __reduce__(self) -> Any:
        return CarTaskSampler.of, (self.apartment, self.car)

    @cached_property
    def _distance(self) -> GoalDistance:
        # The largest disc around the rear axle that the footprint covers.
        radius = min(self.car.rear_overhang, 0.5 * self.car.width)
        return GoalDistance(FreeSpace.from_apartment(self.apartment, radius, self.car.height))

    def goal_distance(self) -> GoalDistance:
        """Return a distance field for a disc inside the footprint, whose goal the caller sets.

        All of them share one graph.
        """
        return copy.copy(self._distance)

    def draw(self, rng: np.random.Generator, targets: Targets = "poses", task_id: int = 0) -> CarTask:
        """Draw a task in the largest connected part: the first of ``rng`` that is one.

        Raises :class:`InputError` where the car finds no two poses far enough apart.
        """
        start = self._first(rng, 0, None)
        return self.goal_from(rng, start, targets, task_id, part=0)

    def goal_from(
        self,
        rng: np.random.Generator,
        start: PlanarPose,
        targets: Targets = "poses",
        task_id: int = 0,
        part: int | None = None,
    ) -> CarTask:
        """Draw a task from a pose, however close to obstacles, to a target that can be reached from there.

        Raises :class:`InputError` where there is none.
        """
        if part is None:
            part = max(0, self.space.part(start))
        goal = self._first(rng, part, np.asarray(start[:2]), bays=True)
        goal = goal if targets == "poses" else goal[:2]
        return self._task(task_id, start, goal.tolist())

    def task(self, start: Sequence[float], goal: Sequence[float], task_id: int = 0) -> CarTask:
        """Return the task from ``start`` (x, y, heading) to ``goal``, a point or a pose; raise as :meth:`validate`."""
        task = self._task(task_id, start, goal)
        self.validate(task)
        return task

    def validate(self, task: CarTask) -> None:
        """Raise :class:`InputError` unless the task is of this scene, free at both ends, its goal reachable."""
        source = f"task {task.id} of {task.scene}"
        validated(CarTask, dict(task), source)  # again, since pydantic's model_copy(update=...) checks nothing
        if task.scene != self.apartment.name:
            raise InputError(source, "scene", f"{self.apartment.name!r}; found {task.scene!r}")
        for field, pose, margin in (("start", task.start, -CAR_START_SLACK), ("goal", task.goal, 0.0)):
            if len(pose) == 3 and not self.space.free(np.array(pose), margin):
                obstacles = ", ".join(self.space.obstacles_at(np.array(pose))[:3])
                why = f"it would collide with {obstacles}" if obstacles else "that is off the floor"
                raise InputError(source, field, f"a pose where the car fits; at {_written(pose)} {why}")
        within = self.space.parts_within(np.array(task.goal), GOAL_RADIUS, GOAL_HEADING_TOLERANCE)
        if self.space.part(np.array(task.start)) not in within:
            expected = f"a target that the car can reach from {_written(task.start)}; found {_written(task.goal)}"
            raise InputError(source, "goal", expected)

    @cached_property
    def bays(self) -> Float[np.ndarray, "n 3"]:
        """Return the poses in which the car stands in the middle of a marked bay, two for each."""
        marks = [piece.boxes[0] for piece in self.apartment.furniture if piece.category == BAY]
        poses = []
        for mark in marks:
            along = mark.yaw + (0.0 if mark.size[0] > mark.size[1] else 0.5 * math.pi)
            for heading in (along, along - math.pi):
                x = mark.center[0] - self.car.center_forward * math.cos(heading)
                y = mark.center[1] - self.car.center_forward * math.sin(heading)
                poses.append((x, y, float(wrap_angle(np.float64(heading)))))
        return np.array(poses).reshape(-1, 3).round(4)

    def _first(
        self, rng: np.random.Generator, part: int, away_from: np.ndarray | None, bays: bool = False
    ) -> np.ndarray:
        """Return the first pose of ``rng`` in a connected part, more than TARGET_APART from a point.

        With ``bays`` it is in one of the scene's bays, if there are any.
        """
        for _ in range(_ROUNDS):
            for pose in self._drawn(rng, bays):
                if away_from is not None and math.hypot(*(pose[:2] - away_from)) <= TARGET_APART:
                    continue
                if self.space.part(pose) != part:
                    continue
                # A target must be reachable by its own tolerances, which are tighter than those of `part`.
                if away_from is None or part in self.space.parts_within(pose, GOAL_RADIUS, GOAL_HEADING_TOLERANCE):
                    return pose
        expected = f"room for a car to drive {TARGET_APART} m; no target found that it can reach"
        raise InputError(self.apartment.name, "rooms", expected)

    def _drawn(self, rng: np.random.Generator, bays: bool) -> Float[np.ndarray, "n 3"]:
        if bays and len(self.bays):
            return rng.permutation(self.bays)
        return self.space.sample(rng, _POSES_AT_ONCE, GOAL_MARGIN).round(4)

    def _task(self, task_id: int, start: Sequence[float] | np.ndarray, goal: Sequence[float]) -> CarTask:
        data = {"id": task_id, "scene": self.apartment.name, "start": [float(v) for v in start], "goal": list(goal)}
        return validated(CarTask, data, "task")


def _written(pose: Sequence[float]) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in pose) + ")"
