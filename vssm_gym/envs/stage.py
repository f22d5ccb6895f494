"""What every robot of one kind in one apartment shares: the apartment, its renderer, free space and shortest paths.

Building these takes a second, driving among them microseconds. A process therefore keeps one :class:`Stage` for each
(apartment, robot, camera, renderer, threads) as long as an environment uses it: vector environments, and environments
made one after another, render from the same tables and never build a geodesic twice.
"""

import copy
import threading
import weakref
from functools import cached_property
from typing import Any

import numpy as np

from vssm_gym.axes import Matrix4
from vssm_gym.envs.apartment import Apartment
from vssm_gym.envs.coverage import Observable
from vssm_gym.envs.mjcf import World
from vssm_gym.envs.progress import GoalDistance
from vssm_gym.envs.raycast import RaycastCamera, Tracer
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.sensors import CameraConfig, make_camera, make_tracer
from vssm_gym.envs.solids import SolidBox
from vssm_gym.envs.tasks import TaskSampler

Key = tuple[str, HolonomicRobot, CameraConfig, str, int | None]

_STAGES: "weakref.WeakValueDictionary[Key, Stage]" = weakref.WeakValueDictionary()
_BUILDING = threading.Lock()


def stage_of(
    apartment: Apartment, robot: HolonomicRobot, config: CameraConfig, renderer: str, threads: int | None
) -> "Stage":
    """The process's stage of these, built where there is none."""
    key = (apartment.content_hash(), robot, config, renderer, threads)
    with _BUILDING:
        stage = _STAGES.get(key)
        if stage is None:
            stage = _STAGES[key] = Stage(apartment, robot, config, renderer, threads)
    return stage


class Stage:
    """One apartment made ready for one kind of robot and camera; immutable to its users. Get it by :func:`stage_of`.

    Args:
        apartment: the scene.
        robot: its measures decide what is free.
        config: size and angle of the images.
        renderer: what makes them.
        threads: threads that share an image; None: two where there are two cores.
    """

    def __init__(
        self, apartment: Apartment, robot: HolonomicRobot, config: CameraConfig, renderer: str, threads: int | None
    ) -> None:
        self.apartment, self.robot, self.config = apartment, robot, config
        self.renderer, self.threads = renderer, threads
        self._world = World(apartment, robot)
        self.boxes: list[SolidBox] = self._world.boxes
        self.eye = make_camera(self._world, config, renderer, threads)
        self.camera, self.renderer_name = self.eye.camera, self.eye.name
        # Whether several threads may render at once.
        self.parallel = isinstance(self.eye, RaycastCamera) and self.eye.tracer.parallel

    def __reduce__(self) -> Any:
        return stage_of, (self.apartment, self.robot, self.config, self.renderer, self.threads)

    @cached_property
    def sampler(self) -> TaskSampler:
        """Tasks and free space."""
        return TaskSampler(self.apartment, self.robot)

    @cached_property
    def tracer(self) -> Tracer:
        """What finds the first box along rays."""
        return self.eye.tracer if isinstance(self.eye, RaycastCamera) else make_tracer(self._world)

    @cached_property
    def observable(self) -> Observable:
        """What a robot could see at all."""
        return Observable(self.sampler.space, self.tracer, self.robot.camera_height)

    @cached_property
    def _distance(self) -> GoalDistance:
        return GoalDistance(self.sampler.space)

    def goal_distance(self) -> GoalDistance:
        """A distance field to aim at will; all of them share one graph."""
        return copy.copy(self._distance)

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """The exact image at a camera pose: uint8 ``(H, W, 3)`` and z-depth float32 ``(H, W)``, m, 0 = nothing."""
        return self.eye.render(T_world_cam)
