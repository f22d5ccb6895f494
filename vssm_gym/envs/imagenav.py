"""Define ImageNav: PointNav whose goal is an image, taken at the goal (Zhu et al., ICRA 2017).

The goal's position is not observed, only the image that the robot's own camera, without noise, would take there. The
tables of observation, action, reward and termination are in ``docs/envs/imagenav.md``.
"""

from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from vssm_gym.envs.phased import PhasedEnv, Report
from vssm_gym.envs.pointnav import PointNavEnv
from vssm_gym.envs.rendering.captions import Caption, Panel
from vssm_gym.envs.rendering.topdown import PICTURE, at_height
from vssm_gym.envs.sensors.task_observation import TaskObservation

GOAL_HEADINGS = 8  # directions, evenly spread, in which a goal image may look
OPEN_DEPTH = 1.0  # m, median depth from which a view counts as open: bare walls within reach say nothing about a place


class ImageNavEnv(PhasedEnv):
    """Simulate one robot that drives to where a given image of an apartment was taken.

    Registered as ``vssm_gym/ImageNav-v0``, truncated after 500 steps.

    Args:
        scene: built-in name, ``procedural:SEED``, path of a scene file, or an :class:`Apartment`.
        navigation: all further keywords: those of :class:`~vssm_gym.envs.pointnav.PointNavEnv`, which moves, rewards
            and ends, but for ``goal``.
    """

    passes_to = PointNavEnv
    refuses: ClassVar[Mapping[str, str]] = {"goal": "no such keyword here: the goal is an image"}
    metadata = PointNavEnv.metadata

    def __init__(self, scene: Any = "oak", **navigation: Any) -> None:
        self.navigation = PointNavEnv(scene, **navigation)
        self.frames, self.render_mode = self.navigation.frames, self.navigation.render_mode
        self.parallel = self.navigation.parallel
        self.simulation, self.renderer_name = self.navigation.simulation, self.navigation.renderer_name
        self.success_radius = self.navigation.success_radius
        self.action_space = self.navigation.action_space
        size = (self.navigation.camera.height, self.navigation.camera.width, 3)
        sensors = self.simulation.sensors
        sensors.remove("goal")  # its image replaces its position
        sensors.add(TaskObservation("goal_rgb", gym.spaces.Box(0, 255, size, np.uint8), self._goal))
        self.observation_space = gym.spaces.Dict(sensors.spaces())
        self._goal_rgb: np.ndarray | None = None

    def begin(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start a task as PointNav does; the goal image depends on the task, not on the seed."""
        self.navigation.begin(seed, options)
        self._goal_rgb = None

    def advance(self, action: np.ndarray) -> None:
        """Carry out ``(turn, o, s, stop)`` as PointNav does."""
        self.navigation.advance(action)

    def sense(self) -> None:
        """Take the image and, at the start of an episode, the goal's."""
        self.navigation.sense()

    def report(self) -> Report:
        """Return what PointNav reports, with the goal's image in place of its position."""
        return self.navigation.report()

    def panels(self) -> list[Panel]:
        """Return the camera's image, the goal's and the plan, 360 pixels high."""
        camera, plan = self.navigation.panels()
        return [camera, Panel(at_height(self._goal(), PICTURE), "image of the goal"), plan]

    def captions(self) -> list[Caption]:
        """Return the straight distance to the goal."""
        return self.navigation.captions()

    def _goal(self) -> np.ndarray:
        """Return the goal's image, rendered once an episode."""
        if self._goal_rgb is None:
            self._goal_rgb = self._goal_image()
        return self._goal_rgb

    def _goal_image(self) -> np.ndarray:
        """Render the view from the goal: of eight headings, in an order drawn from the task, the first that is open.

        Where none is open (a niche), take the one with the largest median depth.
        """
        task = self.navigation.task
        assert task is not None
        spread = 2.0 * np.pi * np.arange(GOAL_HEADINGS) / GOAL_HEADINGS
        drawn = np.random.default_rng([task.id, *np.frombuffer(np.array(task.goal).tobytes(), np.uint32)])
        views = []
        for heading in drawn.uniform(0.0, 2.0 * np.pi) + drawn.permutation(spread):
            pose = np.array([*task.goal, heading])
            rgb, depth = self.simulation.view_from(pose)
            views.append((float(np.median(depth)), rgb))
            if views[-1][0] >= OPEN_DEPTH:
                return rgb
        return max(views, key=lambda view: view[0])[1]
