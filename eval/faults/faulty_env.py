"""Wrap an environment so that its camera fails, or its robot is carried off, from one step on."""

from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.errors import InputError
from vssm_gym.eval.faults.injectors import IMAGE_FAULTS, MOTION_FAULTS, Image
from vssm_gym.geometry.transforms import wrap_angle

CARRIED = {"kidnap": (2.0, 6.0, np.pi), "shove": (0.3, 0.6, 0.4)}  # least and largest distance, m; largest turn, rad
PLACES_TRIED = 2000  # places drawn for a robot that is carried off


class FaultyEnv(gym.Wrapper[Any, Any, Any, Any]):
    """Deliver faulty images, or move the robot between two steps; rewards, ``info`` and goal stay true.

    Args:
        env: PointNav, CarNav or Explore, wrapped or not, with images.
        fault: a name of :data:`IMAGE_FAULTS` or of :data:`MOTION_FAULTS`.
        first: step whose image is the first faulty one, from 1 on; a robot is carried off just before that step.
        steps: number of faulty images; None: all to the end. A motion happens once.
        seed: of the fault.
    """

    def __init__(self, env: gym.Env, fault: str, first: int, steps: int | None = None, seed: int = 0) -> None:
        if fault not in (*IMAGE_FAULTS, *MOTION_FAULTS):
            raise InputError(
                "FaultyEnv", "fault", f"one of {', '.join((*IMAGE_FAULTS, *MOTION_FAULTS))}; not {fault!r}"
            )
        super().__init__(env)
        self.fault, self.first, self.steps, self._seed = fault, first, steps, seed
        self.true: list[np.ndarray] = []  # pose at reset and after every step
        self._images: list[Image] = []

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; its first image is intact."""
        observation, info = self.env.reset(**options)
        self._rng = np.random.default_rng(self._seed)
        self.true, self._images = [self._planar()], [(observation["rgb"], observation["depth"])]
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Carry out one step, with the fault from step ``first`` on."""
        now = len(self.true)
        if now == self.first and self.fault in MOTION_FAULTS:
            self._carry_off(*CARRIED[self.fault])
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.true.append(self._planar())
        self._images.append((observation["rgb"], observation["depth"]))
        faulty = self.first <= now and (self.steps is None or now < self.first + self.steps)
        if faulty and self.fault in IMAGE_FAULTS:
            rgb, depth = IMAGE_FAULTS[self.fault](self._images, self.first, self._rng)
            observation = {**observation, "rgb": rgb, "depth": depth}
        return observation, reward, terminated, truncated, info

    def _planar(self) -> Float[np.ndarray, "3"]:
        world: Any = self.env.unwrapped
        return np.array(world.planar)

    def _carry_off(self, least: float, most: float, turn: float) -> None:
        """Move the robot to a random free place between ``least`` and ``most`` m away, turned by up to ``turn`` rad."""
        world: Any = self.env.unwrapped
        here = self._planar()
        for _ in range(PLACES_TRIED):
            away, direction, turned = self._rng.uniform((least, -np.pi, -turn), (most, np.pi, turn))
            step = away * np.array([np.cos(direction), np.sin(direction)])
            there = np.array([*(here[:2] + step), wrap_angle(here[2] + turned)])
            if _fits(world, there):
                _simulator(world).reset(there)
                return
        raise InputError(
            "FaultyEnv", "scene", f"a free place {least:g} to {most:g} m from {here[:2].round(2).tolist()}"
        )


def _fits(world: Any, planar: Float[np.ndarray, "3"]) -> bool:
    """Return True where the robot of an environment is free of obstacles."""
    if hasattr(world, "car"):
        return bool(world.sampler.space.free(planar))
    return bool(world.simulation.scene_cache.sampler.space.contains(planar[:2]))


def _simulator(world: Any) -> Any:
    """Return the object that places the robot of an environment: ``reset((x, y, heading))``."""
    return world.body if hasattr(world, "car") else world.simulation.world
