"""What every robot of one kind in one apartment shares: free space, tasks, shortest paths, what can be seen.

Like the scenery (:mod:`vssm_gym.envs.sensors.shared_renderer`) it takes a second to build and microseconds to use, so
that a process keeps one of each.
"""

import copy
import threading
import weakref
from functools import cached_property
from typing import Any

from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.sensors.shared_renderer import Scenery
from vssm_gym.envs.tasks.coverage import Observable
from vssm_gym.envs.tasks.goal_progress import GoalDistance
from vssm_gym.envs.tasks.navigation import TaskSampler

_STAGES: "weakref.WeakValueDictionary[tuple[int, Robot], Stage]" = weakref.WeakValueDictionary()
_BUILDING = threading.Lock()


def stage_of(scenery: Scenery, robot: Robot) -> "Stage":
    """The process's stage of these, built where there is none."""
    with _BUILDING:
        stage = _STAGES.get((id(scenery), robot))  # a stage keeps its scenery, and so its id
        if stage is None:
            stage = _STAGES[(id(scenery), robot)] = Stage(scenery, robot)
    return stage


class Stage:
    """Scenery made ready for one kind of robot; immutable to its users. Get it by :func:`stage_of`.

    Args:
        scenery: apartment and renderer.
        robot: its measures decide what is free.
    """

    def __init__(self, scenery: Scenery, robot: Robot) -> None:
        self.scenery, self.robot = scenery, robot

    def __reduce__(self) -> Any:
        return stage_of, (self.scenery, self.robot)

    @cached_property
    def sampler(self) -> TaskSampler:
        """Tasks and free space."""
        return TaskSampler(self.scenery.apartment, self.robot)

    @cached_property
    def observable(self) -> Observable:
        """What a robot could see at all."""
        return Observable(self.sampler.space, self.scenery.tracer, self.robot.camera_height)

    @cached_property
    def _distance(self) -> GoalDistance:
        return GoalDistance(self.sampler.space)

    def goal_distance(self) -> GoalDistance:
        """A distance field to aim at will; all of them share one graph."""
        return copy.copy(self._distance)
