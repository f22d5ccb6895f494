"""Check the keywords of an imagined environment."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from vssm_gym.envs.robots import ExecutionNoise, HolonomicRobot, execution_noise
from vssm_gym.envs.robots.car_noise import CarNoise, car_noise
from vssm_gym.envs.sensors import CameraConfig, camera_config
from vssm_gym.envs.validation import choose
from vssm_gym.errors import InputError
from vssm_gym.geometry.scan import MAX_DEPTH
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.learned_file import load_transition

SOURCE = "WorldModelNav"
# Keywords of the constructors that are not fields of Imagination
OWN = ("map", "render_mode", "captions")
CHOICES: dict[str, tuple[str, ...]] = {
    "robot": ("holonomic", "car"),
    "observation": ("scan", "depth", "rgbd"),
    "end_on": ("stop", "reach"),
    "reward": ("dense", "sparse"),
    "unknown": ("blocked", "free", "penalised"),
}


@dataclass(frozen=True)
class Imagination:
    """Hold the keywords of the environment; see ``docs/envs/world_model_nav.md``.

    Args:
        robot: ``holonomic`` stands for PointNav, ``car`` for CarNav with ``targets="points"``.
        observation: ``scan``, ``depth`` or ``rgbd``.
        noise: a noise level of the real environment, its noise dataclass, or a pair of them, between which each
            episode draws its own; a learned ``transition`` has its own instead.
        transition: file of a transition that `vssm-gym train-dynamics` has learned from drives of the real robot; None:
            the law of the robot's kind.
        camera: intrinsics of images; a scan takes its field of view.
        max_depth: range of the sensor, m; farther surfaces give no reading.
        end_on: as PointNav's keyword; a car always ends on arrival.
        reward: ``dense`` or ``sparse``.
        unknown: whether unobserved space blocks a robot, is free, or is free at a cost.
        map_samples: number of maps drawn from the posterior, of which each episode takes one; 0: the posterior's mean.
        start_std: standard deviations of the true start about the task's start, which is the initial pose estimate:
            forward (m), left (m), turn (rad).
        pose_std: stationary standard deviations of the pose estimate's error, likewise.
        pose_memory: autocorrelation of that error from one step to the next.
        show_uncertainty: whether the observation holds ``pose_std``.
        tasks: a ``TaskSet`` or sequence of tasks with ``start`` and ``goal``; None: drawn in free space.
        pool: number of tasks that are drawn.
        goals: number of goals among them.
        pool_seed: seed of the tasks and of the sampled maps.
    """

    robot: Literal["holonomic", "car"] = "holonomic"
    observation: Literal["scan", "depth", "rgbd"] = "scan"
    noise: Any = "low"
    transition: str | Path | None = None
    camera: CameraConfig | Mapping[str, Any] | None = None
    max_depth: float = MAX_DEPTH
    end_on: Literal["stop", "reach"] = "stop"
    reward: Literal["dense", "sparse"] = "dense"
    unknown: Literal["blocked", "free", "penalised"] = "blocked"
    map_samples: int = 0
    start_std: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pose_std: tuple[float, float, float] = (0.02, 0.02, 0.01)
    pose_memory: float = 0.8
    show_uncertainty: bool = False
    tasks: Any = field(default=None, compare=False)
    pool: int = 4096
    goals: int = 64
    pool_seed: int = 0

    def __post_init__(self) -> None:
        for name, available in CHOICES.items():
            choose(SOURCE, name, getattr(self, name), available)
        for name, least, most in (
            ("map_samples", 0, 64),
            ("pool", 1, 10**6),
            ("goals", 1, 1024),
            ("pool_seed", 0, 2**31),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not (isinstance(value, int) and least <= value <= most):
                raise InputError(SOURCE, name, f"a whole number from {least} to {most}; found {value!r:.80}")
        for name in ("start_std", "pose_std"):
            checked_stds(name, getattr(self, name))
        for name, limit in {"max_depth": 100.0, "pose_memory": 1.0}.items():
            value = getattr(self, name)
            if isinstance(value, bool) or not (isinstance(value, int | float) and 0.0 <= value <= limit):
                raise InputError(SOURCE, name, f"a number from 0 to {limit:g}; found {value!r:.80}")
        if not isinstance(self.show_uncertainty, bool):
            raise InputError(SOURCE, "show_uncertainty", f"True or False; found {self.show_uncertainty!r:.80}")
        if self.transition is not None and not isinstance(self.transition, str | Path):
            raise InputError(SOURCE, "transition", f"a file of vssm-gym train-dynamics; found {self.transition!r:.80}")
        object.__setattr__(self, "camera", CameraConfig(64, 48) if self.camera is None else camera_config(self.camera))
        self.noise_range()

    @classmethod
    def of(cls, keywords: Mapping[str, Any]) -> "Imagination":
        """Check the keywords of ``gym.make``; raise :class:`InputError` that lists the keywords for an unknown one."""
        names = [one.name for one in fields(cls)]
        for name in keywords:
            if name not in names:
                expected = f"one of its keywords: {', '.join((OWN[0], *names, *OWN[1:]))}"
                raise InputError(SOURCE, name, expected)
        return cls(**keywords)

    def learned(self) -> LearnedTransition | None:
        """Read the learned transition; raise :class:`InputError` where it is of another robot."""
        if self.transition is None:
            return None
        transition, kind, _ = load_transition(self.transition)
        if kind != self.robot:
            raise InputError(self.transition, "kind", f"{self.robot}, the robot of this environment; found {kind}")
        if transition.further:
            expected = f"{transition.nominal.controls} controls, those of the robot; found {transition.controls}"
            raise InputError(self.transition, "further", expected)
        step = float(transition.scales.step)
        if self.robot == "holonomic" and abs(step - HolonomicRobot.dt) > 1e-3:  # its controls are displacements
            raise InputError(self.transition, "scales.step", f"{HolonomicRobot.dt} s, the robot's step; found {step:g}")
        return transition

    def noise_range(self) -> tuple[Any, Any]:
        """Return the two ends of the noise range, :class:`ExecutionNoise` or :class:`CarNoise`."""
        parse: Any = execution_noise if self.robot == "holonomic" else car_noise
        pair = isinstance(self.noise, Sequence) and not isinstance(self.noise, str)
        if pair and len(self.noise) != 2:
            raise InputError(SOURCE, "noise", f"one level, or a pair of them; found {self.noise!r:.80}")
        low, high = (parse(one) for one in (self.noise if pair else (self.noise, self.noise)))
        return low, high


def noise_parameters(noise: ExecutionNoise | CarNoise) -> tuple[float, ...]:
    """Return the parameters of a noise level: (turn, step), or the car's lags, spreads and jitters."""
    if isinstance(noise, ExecutionNoise):
        return noise.turn, noise.step
    names = ("speed_lag", "steering_lag", "calibration", "trim", "speed_jitter", "steering_jitter")
    return tuple(float(getattr(noise, name)) for name in names)


def checked_stds(name: str, value: Any) -> None:
    """Raise :class:`InputError` unless ``value`` is three standard deviations."""
    numbers = isinstance(value, Sequence) and len(value) == 3
    if not numbers or not all(isinstance(v, int | float) and math.isfinite(v) and v >= 0.0 for v in value):
        raise InputError(SOURCE, name, f"three standard deviations (m, m, rad), none negative; found {value!r:.80}")
