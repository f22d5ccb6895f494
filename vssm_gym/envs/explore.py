"""Define Explore: a noisy holonomic robot with an RGB-D camera observes as much of an unknown apartment as it can.

It acts ``(turn, o, s, stop)`` at 5 Hz like PointNav's robot; its pose is observed unless that is switched off. Reward
and score are the coverage of what a robot of its size could see at all (:mod:`vssm_gym.envs.tasks.coverage`). The
tables of observation, action, reward and termination are in ``docs/envs/explore.md``.
"""

from typing import Any, Literal

import gymnasium as gym
import numpy as np

from vssm_gym.envs.phased import PhasedEnv, Report
from vssm_gym.envs.rendering.captions import Caption, Panel
from vssm_gym.envs.simulation import Simulation
from vssm_gym.envs.tasks.coverage import Coverage
from vssm_gym.envs.tasks.navigation import BORDER_MARGIN
from vssm_gym.envs.tasks.rewards import DenseReward
from vssm_gym.envs.validation import check_options, choose
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose

EXPLORE_REWARD = DenseReward(step_cost=0.005, gain=10.0)  # gain: of the whole coverage


class ExploreEnv(PhasedEnv):
    """Simulate one robot that observes as much of an unknown apartment as it can.

    Registered as ``vssm_gym/Explore-v0``, truncated after 2000 steps.

    Args:
        scene: built-in name, ``procedural:SEED``, path of a scene file, or an :class:`Apartment`.
        reward: ``dense`` (ten times the coverage gained, less a cost a step) or ``sparse`` (1 when finished).
        finish: coverage at which the episode ends with success; above 1 it never does.
        observe_pose: if True, the observation holds the true pose, as in the published experiments.
        simulation: all further keywords: ``noise``, ``sensor_noise``, ``camera`` and the others of
            :class:`~vssm_gym.envs.simulation.Simulation`.
    """

    passes_to = Simulation
    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 5}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        scene: Any = "oak",
        *,
        reward: Literal["dense", "sparse"] = "dense",
        finish: float = 0.99,
        observe_pose: bool = True,
        **simulation: Any,
    ) -> None:
        choose("Explore", "reward", reward, ("dense", "sparse"))
        if not (isinstance(finish, int | float) and finish > 0.0):
            raise InputError("Explore", "finish", f"a share above 0; found {finish!r}")
        self.simulation = Simulation(scene, observe_pose=observe_pose, **simulation)
        self.reward, self.finish, self.robot = reward, float(finish), self.simulation.robot
        self.frames, self.render_mode = self.simulation.frames, self.simulation.frames.mode
        self.renderer_name = self.simulation.renderer.name
        self.parallel = self.simulation.parallel
        if self.simulation.varies("camera_height"):
            raise InputError("Explore", "randomize", "no camera_height: what can be seen at all depends on it")
        self._adopt()
        self.action_space = self.simulation.action_space()
        self.observation_space = gym.spaces.Dict(self.simulation.sensors.spaces())
        self._outcome: tuple[float, bool, dict[str, Any]] | None = None  # reward, terminated, info

    @property
    def planar(self) -> PlanarPose:
        """Return the true ``(x, y, heading)``, m and rad; not for agents."""
        return self.simulation.planar

    def begin(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start at ``options["start"]``, ``(x, y, heading)`` in m and rad, or anywhere free, by the task stream.

        Raises :class:`InputError` where the robot does not fit there.
        """
        given = check_options(options, "start").get("start")
        self.simulation.seed(seed)
        if self.simulation.vary():
            self._adopt()
        start = self._start(given)
        self.simulation.place(start)
        self.coverage.reset()
        self.coverage.see(self.planar)
        self._outcome = 0.0, False, self._info(self.simulation.rest, collision=False) | {"start_pose": start}

    def advance(self, action: np.ndarray) -> None:
        """Carry out ``(turn, o, s, stop)``; a stop ends the episode without a motion."""
        command, stop = self.simulation.parse(action)
        command = self.simulation.rest if stop else command
        collision = False if stop else self.simulation.drive(command)
        gained = self.coverage.see(self.planar)
        finished = self.coverage.fraction >= self.finish
        reward = EXPLORE_REWARD.gain * gained - EXPLORE_REWARD.step_cost if self.reward == "dense" else float(finished)
        info = self._info(command, collision)
        if stop or finished:
            info["success"] = finished
        self._outcome = reward, stop or finished, info

    def sense(self) -> None:
        """Take the image."""
        self.simulation.sense()

    def report(self) -> Report:
        """Return observation, reward, terminated, truncated (always False: a wrapper counts steps) and info."""
        assert self._outcome is not None
        reward, terminated, info = self._outcome
        return self.simulation.observation(), reward, terminated, False, info

    def panels(self) -> list[Panel]:
        """Return the camera's image and the plan with the path so far, 360 pixels high."""
        return self.simulation.panels()

    def captions(self) -> list[Caption]:
        """Return the coverage."""
        return [Caption("coverage", f"{self.coverage.fraction:.1%}")]

    def _adopt(self) -> None:
        """Take scene, camera and noise of the simulation, which may vary from episode to episode."""
        simulation = self.simulation
        self.apartment, self.camera, self.noise = simulation.apartment, simulation.camera, simulation.noise
        self.coverage = Coverage(simulation.scene_cache.observable, simulation.hfov)

    def _info(self, command: np.ndarray, collision: bool) -> dict[str, Any]:
        driven = {"coverage": self.coverage.fraction, "path_length": self.simulation.path_length}
        return self.simulation.info(command, collision) | driven

    def _start(self, given: Any) -> np.ndarray:
        space, stream = self.simulation.scene_cache.sampler.space, self.simulation.streams["task"]
        drawn = np.array([*space.sample(stream, 1, BORDER_MARGIN)[0], stream.uniform(-np.pi, np.pi)])
        if given is None:
            return drawn
        try:
            start = np.asarray(given, dtype=np.float64)
        except (TypeError, ValueError):
            start = np.full(0, np.nan)
        if start.shape != (3,) or not np.isfinite(start).all():
            raise InputError("reset", "options['start']", f"finite numbers (x, y, heading); found {given!r:.80}")
        if not space.contains(start[:2]):
            obstacles = ", ".join(space.obstacles_at(start[:2])[:3]) or "the end of the floor"
            expected = f"a position where the robot fits; it would collide with {obstacles}"
            raise InputError("reset", "options['start']", expected)
        return start
