"""State the numbers behind a track that its file does not hold: noise levels, sensors, robots, limits and scores.

A suite freezes their hash, so that a version of the package that has other ones refuses to run it.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from typing import Any

import numpy as np

from vssm_gym.envs.carnav import STANDING_SPEED
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.robots import car_noise, holonomic
from vssm_gym.envs.robots.car_body import DYNAMICS
from vssm_gym.envs.sensors import rgbd_noise
from vssm_gym.envs.sensors.camera import CameraConfig
from vssm_gym.envs.tasks import coverage
from vssm_gym.envs.tasks.car import GOAL_MARGIN
from vssm_gym.envs.tasks.navigation import GOAL_APART, SHORTEST, SUCCESS
from vssm_gym.eval.bench.prediction import run as predicted
from vssm_gym.eval.bench.slam import ASTRAY_ERROR, FRAME_RATE
from vssm_gym.eval.benchmark.prediction import levels
from vssm_gym.eval.benchmark.scores import COVERAGE_STEP
from vssm_gym.eval.metrics.exploration import COVERAGE_GOAL
from vssm_gym.eval.studies.calibration import drives
from vssm_gym.eval.sweep.supervision import WAITING
from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.geometry.car import GOAL_RADIUS, Car

DIGITS = 10  # significant ones of a number that is hashed


def rules_hash(kind: str, env: str | None = None) -> str:
    """Return the first 16 hex digits of the SHA-256 of the numbers of a track."""
    stated = json.dumps(plain(rules(kind, env)), sort_keys=True)
    return hashlib.sha256(stated.encode()).hexdigest()[:16]


def rules(kind: str, env: str | None = None) -> dict[str, Any]:
    """Return the numbers of a track by name.

    Args:
        kind: of the track: "driving", "slam" or "prediction".
        env: the environment in which agents drive.
    """
    own: dict[str, Any]
    shared = {
        "waiting": WAITING,
        "camera": CameraConfig(),
        "sensors": rgbd_noise.PRESETS,
        "max_depth": MAX_DEPTH,
        "holonomic": holonomic.HolonomicRobot(),
        "noise": holonomic.HOLONOMIC_NOISES,
    }
    if env is not None:
        spec = ENVIRONMENTS[env]
        own = {"steps": spec.max_episode_steps, "keywords": spec.keywords}
        if spec.robot == "car":
            at_goal = {"radius": GOAL_RADIUS, "margin": GOAL_MARGIN, "speed": STANDING_SPEED}
            own |= {"car": Car(), "dynamics": DYNAMICS, "noise": car_noise.NOISE_LEVELS, "goal": at_goal}
        elif spec.task == "explore":
            seen = {"cell": coverage.COVERAGE_CELL, "range": coverage.SEEING_RANGE}
            own |= {"coverage": seen, "goal": COVERAGE_GOAL, "every": COVERAGE_STEP}
        else:
            own |= {"goal": {"apart": GOAL_APART, "success": SUCCESS, "shortest": SHORTEST}}
    elif kind == "prediction":
        own = {
            "horizons": predicted.HORIZONS,
            "noise": [predicted.NOISE, predicted.SENSOR_NOISE],
            "times": [predicted.FIRST_PREDICTION, predicted.PREDICT_EVERY, drives.DRIVE_FRAMES],
            "stride": predicted.PIXEL_STRIDE,
            "bins": [levels.LEAST_BIN, levels.GREY_LEVELS, levels.IGNORANT, levels.EITHER],
        }
    else:
        own = {"rate": FRAME_RATE, "astray": ASTRAY_ERROR}
    return shared | own


def plain(value: Any) -> Any:
    """Return a value of lists, numbers and texts for JSON, with numbers of DIGITS digits."""
    if is_dataclass(value) and not isinstance(value, type):
        return {"kind": type(value).__name__, **plain(asdict(value))}
    if isinstance(value, Mapping):
        return {str(name): plain(one) for name, one in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, bool | str) or value is None:
        return value
    return f"{float(value):.{DIGITS}g}"
