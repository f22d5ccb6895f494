"""Share the free space, task sampler, shortest paths and observable walls of one apartment among its robots.

They take a second to build and microseconds to use. A process therefore keeps one :class:`SceneCache` for each
(renderer, robot), as it keeps one renderer for each apartment (:mod:`vssm_gym.envs.sensors.shared_renderer`).
"""

import copy
import threading
import weakref
from functools import cached_property
from typing import Any, ClassVar

from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.envs.tasks.coverage import Observable
from vssm_gym.envs.tasks.goal_progress import GoalDistance
from vssm_gym.envs.tasks.navigation import TaskSampler


class SceneCache:
    """Hold what tasks need of one apartment for one kind of robot. Get it by :meth:`of`; it is immutable to its users.

    Args:
        renderer: the apartment and its renderer.
        robot: the robot, whose dimensions decide where it is free.
    """

    _instances: ClassVar["weakref.WeakValueDictionary[tuple[int, Robot], SceneCache]"] = weakref.WeakValueDictionary()
    _lock: ClassVar = threading.Lock()

    def __init__(self, renderer: SharedRenderer, robot: Robot) -> None:
        self.renderer, self.robot = renderer, robot

    @classmethod
    def of(cls, renderer: SharedRenderer, robot: Robot) -> "SceneCache":
        """Return the process's cache of these two, which is built where there is none."""
        key = (id(renderer), robot)  # the cache keeps its renderer alive, and so the id
        with cls._lock:
            cache = cls._instances.get(key)
            if cache is None:
                cache = cls._instances[key] = cls(renderer, robot)
        return cache

    def __reduce__(self) -> Any:
        return SceneCache.of, (self.renderer, self.robot)

    @cached_property
    def sampler(self) -> TaskSampler:
        """Return the task sampler, which holds the free space."""
        return TaskSampler(self.renderer.apartment, self.robot)

    @cached_property
    def observable(self) -> Observable:
        """Return the cells of the plan that the robot's camera can see from anywhere in the free space."""
        return Observable(self.sampler.space, self.renderer.tracer, self.robot.camera_height)

    @cached_property
    def _distance(self) -> GoalDistance:
        return GoalDistance(self.sampler.space)

    def goal_distance(self) -> GoalDistance:
        """Return a distance field whose goal the caller sets; all of them share one graph."""
        return copy.copy(self._distance)
