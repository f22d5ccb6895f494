"""Compare Gaussians of one image's pose in a known map, Laplace's, variational, the filter's: ``bench beliefs``.

All three share the prior and the alignment's cost. Laplace's approximation takes the curvature at the MAP, the
variational one mean and curvature over itself, the filter's the errors of surfaces by their patches (eq. I16). They are
judged by the true pose: ``NEES / 6``, the share inside the 95 % region, and ``-log q(true pose)``.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.sensors.camera import CameraConfig, make_camera
from vssm_gym.envs.sensors.rgbd_noise import NoisySensor, sensor_noise
from vssm_gym.eval.metrics.pose_calibration import inside_region
from vssm_gym.files.shipped import MAPS, shipped
from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.geometry.transforms import inverse, planar_to_matrix, se3_adjoint, se3_exp, se3_log
from vssm_gym.inference.alignment.gauss_newton import align
from vssm_gym.inference.alignment.reference_view import ReferenceView, from_map
from vssm_gym.inference.alignment.residuals import (
    linearise,
    make_observed,
    make_reference,
    normal_equations,
    score,
    stride,
)
from vssm_gym.inference.alignment.surface_error import SurfaceErrorConfig, influence
from vssm_gym.inference.alignment.variational import variational_gaussian
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.pose_update import gain
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.progress import OnProgress

SCENE = "oak"  # whose learned map comes with the package
SIZE = (160, 120)  # pixels
PREDICTION_STD = np.array([0.03] * 3 + [np.radians(1.5)] * 3)  # m, rad: the prediction of a filter that follows a hand
TILT = 0.2  # rad, standard deviation of the camera's tilt and roll
LEAST_MEDIAN = 0.5  # m, of depth: nearer views are a surface in front of the lens
BELIEFS = ("laplace", "variational", "filter")


class Beliefs(NamedTuple):
    """Hold the pose's Gaussians, one a row in the order of ``BELIEFS``, in the tangents at their own means."""

    T_world_cam: Float[Array, "beliefs 4 4"]
    covariance: Float[Array, "beliefs 6 6"]
    score: Float[Array, ""]  # of the alignment


@dataclass(frozen=True)
class Judged:
    """Hold how one image's beliefs see the true pose, in the order of ``BELIEFS``."""

    nees: Float[np.ndarray, "beliefs"]
    surprise: Float[np.ndarray, "beliefs"]  # -log q(true pose), nats
    score: float


def compare(
    frames: int, seed: int = 0, config: TrackingConfig | None = None, on_progress: OnProgress | None = None
) -> dict[str, Any]:
    """Judge the beliefs at random poses of an apartment with a Kinect's noise.

    Args:
        frames: accepted ones that are judged.
        seed: of poses, priors and noise.
        config: whose alignment and gates are used; None: those of a hand-held camera.
        on_progress: called with ("poses", frames done, frames).

    Returns:
        ``scene``, ``frames``, and ``beliefs``: of each by its name ``nees`` over the dimension, the share ``inside``
        the 95 % region and ``surprise`` (nats), with standard errors.
    """
    config = config or TrackingConfig()
    apartment, robot = load_scene(SCENE), HolonomicRobot()
    m = VoxelMap.load(shipped(SCENE, MAPS))
    settings = CameraConfig(*SIZE)
    rays = make_camera(apartment.boxes(), settings)
    sensor = NoisySensor(sensor_noise("kinect"), rays.camera, np.random.default_rng([seed, 1]))
    rng, camera = np.random.default_rng([seed, 0]), settings.intrinsics()
    free = FreeSpace.from_apartment(apartment, robot.radius, robot.height)
    judged: list[Judged] = []
    while len(judged) < frames:
        planar = np.array([*free.sample(rng, 1)[0], rng.uniform(-np.pi, np.pi)])
        tilt = np.array([0.0, 0.0, 0.0, *rng.normal(0.0, TILT, 3)])
        T_true = planar_to_matrix(planar) @ robot.T_body_cam @ np.asarray(se3_exp(jnp.asarray(tilt, jnp.float32)))
        off = rng.normal(0.0, PREDICTION_STD)
        T_prior = jnp.asarray(T_true, jnp.float32) @ se3_exp(jnp.asarray(off, jnp.float32))
        rgb, depth = rays.render(T_true)
        if np.median(depth) < LEAST_MEDIAN:
            continue
        image = RGBD.from_camera(*sensor(rgb, depth, 10.0))  # s, after which the exposure is another one
        one = _judge(T_true, beliefs(from_map(m, T_prior, camera, MAX_DEPTH), image, camera, config))
        if one.score >= config.min_score:
            judged.append(one)
            if on_progress:
                on_progress("poses", len(judged), frames)
    rays.close()
    return {
        "scene": SCENE,
        "frames": frames,
        "beliefs": {name: _summary(judged, k) for k, name in enumerate(BELIEFS)},
    }


@partial(jax.jit, static_argnames="config")
def beliefs(reference: ReferenceView, image: RGBD, camera: Camera, config: TrackingConfig) -> Beliefs:
    """Return the three Gaussians of an image, whose prior is about the reference's pose.

    Args:
        reference: the map, rendered at the prior's mean.
        image: of the camera.
        camera: of both.
        config: of the alignment.
    """
    basis, P = jnp.eye(6), jnp.diag(jnp.asarray(PREDICTION_STD, jnp.float32) ** 2)
    precision, settings = jnp.linalg.inv(P), config.align
    here = jnp.eye(4)
    T, info = align(here, precision, here, basis, reference.image, image, camera, settings)
    ref = make_reference(reference.image, camera, settings)
    obs = make_observed(image, camera, 1, stride(camera, 1, settings))

    def equations(xi: Array) -> tuple[Array, Array]:
        at = T @ se3_exp(xi)
        H, g = normal_equations(*linearise(at, ref, obs, camera, 1, settings))
        twists = se3_adjoint(at)
        return twists.T @ H @ twists + precision, twists.T @ g + precision @ se3_log(at)

    curvature, _ = equations(jnp.zeros(6))
    laplace = jnp.linalg.inv(curvature)
    mean, variational = variational_gaussian(equations, jnp.zeros(6), laplace)
    errors = influence(T, basis, reference, image, camera, settings, config.surface_error or SurfaceErrorConfig())
    made = gain(P, jnp.ones(()), errors.curvature)
    corrected = made.kept @ P @ made.kept.T + made.K @ errors.covariance @ made.K.T
    poses = jnp.stack([T, T @ se3_exp(mean), T])
    return Beliefs(reference.T_world_cam @ poses, jnp.stack([laplace, variational, corrected]), score(info))


def _judge(T_true: Float[np.ndarray, "4 4"], found: Beliefs) -> Judged:
    e = np.asarray(se3_log(inverse(found.T_world_cam) @ jnp.asarray(T_true, jnp.float32)), float)
    S = np.asarray(found.covariance, float)
    nees = np.einsum("bi,bi->b", e, np.linalg.solve(S, e[..., None])[..., 0])
    return Judged(nees, 0.5 * (nees + np.linalg.slogdet(2.0 * np.pi * S)[1]), float(found.score))


def _summary(judged: list[Judged], k: int) -> dict[str, float]:
    nees, surprise = (np.array([getattr(one, field)[k] for one in judged]) for field in ("nees", "surprise"))
    root = np.sqrt(len(judged))
    return {
        "nees": float(nees.mean() / 6.0),
        "nees_error": float(nees.std() / 6.0 / root),
        "median_nees": float(np.median(nees) / 6.0),
        "inside": float(inside_region(nees, 6).mean()),
        "surprise": float(surprise.mean()),
        "surprise_error": float(surprise.std() / root),
    }
