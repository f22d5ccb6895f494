"""Refine a finished run: smooth all of its poses at once, and make the map anew at the smoothed ones.

The filter knows of the past alone, and never corrects a pose or what it has written into the map. The smoother
(:mod:`vssm_gym.inference.smoothing.gauss_newton`) weighs all images at once. A long run is smoothed at some of its
frames; those between two of them move with both, so that they keep the filter's motion from image to image.
"""

import time
from dataclasses import dataclass, replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym.geometry.transforms import inverse, se3_adjoint, se3_exp, se3_log
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.mapping import rolling_window
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.inference.prism.filter import Prism, with_sensor_errors
from vssm_gym.inference.prism.imu_control import ImuControl
from vssm_gym.inference.smoothing.gauss_newton import ColourPrior, Smoothed, SmoothingConfig, smooth
from vssm_gym.inference.smoothing.views import StackedViews, stack_views
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition.manifold import RigidState
from vssm_gym.model.transition.rigid import rigid_belief
from vssm_gym.progress import OnProgress
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import SlamRun

MOST_NODES = 300  # frames that are smoothed: the time of an iteration grows with their square
FEWEST_NODES = 3  # accepted frames below which nothing is smoothed
STATED_POSES = 64  # whose poses' errors the map holds
FIRST_POSE_STD = 1e-4  # m, rad: std of the first pose, which is the world's


@dataclass(frozen=True)
class Refinement:
    """Hold the outcome.

    Attributes:
        filtered: the run before.
        run: the same frames at smoothed poses, with a posterior whose map was made from them.
        nodes: numbers of the frames that were smoothed.
        costs: mean residual in standard deviations before each iteration.
        seconds: that it took.
    """

    filtered: SlamRun
    run: SlamRun
    nodes: Int[np.ndarray, "nodes"]
    costs: list[float]
    seconds: float


def refine(run: SlamRun, options: SlamOptions, on_progress: OnProgress | None = None) -> Refinement:
    """Smooth a run of PRISM.

    Args:
        run: finished; a run with fewer than three accepted frames keeps its poses.
        options: of the run.
        on_progress: called after each image read, each iteration and each image mapped.

    Returns:
        The refined run. Frames that the filter lost stay out of it, and move with their neighbours.
    """
    began = time.perf_counter()
    prism = options.prism(run.reader.camera)
    accepted = np.flatnonzero(~run.lost)
    progress = on_progress or (lambda stage, done, total: None)
    if len(accepted) < FEWEST_NODES:
        if options.method == "smoother":  # whose images enter the map only when they leave its window
            m = _mapped(run, prism, options, accepted, run.poses, progress)
            run = replace(run, posterior=replace(run.posterior, map=m))
        return Refinement(run, run, accepted, [], time.perf_counter() - began)
    nodes = nodes_of(run)
    images = []
    for done, i in enumerate(nodes, 1):
        images.append(_image(run, int(i)))
        progress("reading", done, len(nodes))
    align = options.tracking.align
    views = stack_views(images, run.reader.camera, (align.geo_sigma, align.geo_sigma_quadratic))
    found = smooth_nodes(run, options, nodes, views, progress)
    T_world_cam = carried(run.poses, nodes, np.asarray(found.states.T_world_body, np.float64))
    nearest = np.abs(np.arange(len(run.frames))[:, None] - nodes).argmin(axis=1)
    velocity = np.asarray(found.states.velocity, np.float64)
    covariance = _with_sensor_errors(found, prism)
    frames = tuple(
        replace(frame, T_world_cam=T_world_cam[i], covariance=covariance[k], velocity=velocity[k])
        for i, (frame, k) in enumerate(zip(run.frames, nearest, strict=True))
    )
    m = _mapped(run, prism, options, accepted, T_world_cam, progress)
    errors = _pose_errors(T_world_cam[nodes], found.covariance[:, :6, :6], run, options)
    last = jax.tree.map(lambda leaf: leaf[-1], found.states)
    belief = rigid_belief(last, jnp.asarray(found.covariance[-1], jnp.float32))
    posterior = Posterior(belief, replace(m, pose_errors=errors), run.posterior.measurement_noise)
    seconds = time.perf_counter() - began
    return Refinement(run, replace(run, frames=frames, posterior=posterior), nodes, found.costs, seconds)


def nodes_of(run: SlamRun) -> Int[np.ndarray, "nodes"]:
    """Return the numbers of the frames that are smoothed: those that were accepted, or some of many."""
    accepted = np.flatnonzero(~run.lost)
    return accepted[np.unique(np.linspace(0, len(accepted) - 1, MOST_NODES).round().astype(int))]


def smooth_nodes(
    run: SlamRun,
    options: SlamOptions,
    nodes: Int[np.ndarray, "nodes"],
    views: StackedViews,
    progress: OnProgress,
    colour_prior: ColourPrior | None = None,
) -> Smoothed:
    """Smooth some frames of a run.

    Args:
        run: finished, of PRISM or of the smoother.
        options: of the run.
        nodes: numbers of the frames, ascending.
        views: their images.
        progress: called after each iteration.
        colour_prior: over the calibration of the views' colour camera, where that is learned.
    """
    transition = options.filter(run.reader.camera).transition
    states = RigidState(
        jnp.asarray(run.poses[nodes], jnp.float32),
        jnp.asarray([_velocity(run, int(i)) for i in nodes], jnp.float32),
    )
    manifold, config = transition.manifold, SmoothingConfig(align=options.tracking.align)
    start = at_rest(manifold, states.T_world_body[0], FIRST_POSE_STD**2 * jnp.eye(6), options.tracking.start_velocity)
    return smooth(
        jax.random.key(options.seed),
        views,
        Rig.of(run.reader.camera),
        transition,
        start,
        states,
        _controls(run, options, nodes, transition.controls),
        jnp.asarray(np.diff(run.times[nodes]), jnp.float32),
        config,
        lambda k, cost: progress("smoothing", k + 1, len(config.gates)),
        colour_prior,
    )


def carried(
    T_world_cam: Float[np.ndarray, "frames 4 4"],
    nodes: Int[np.ndarray, "nodes"],
    smoothed: Float[np.ndarray, "nodes 4 4"],
) -> Float[np.ndarray, "frames 4 4"]:
    """Move all poses by the corrections of some: ``C = C_a exp(s log(C_a^-1 C_b))`` between nodes a and b.

    Args:
        T_world_cam: of all frames.
        nodes: numbers of those that were corrected, ascending.
        smoothed: their corrected poses.
    """
    corrections = smoothed @ inverse(T_world_cam[nodes])
    frame = np.arange(len(T_world_cam))
    after = np.clip(np.searchsorted(nodes, frame), 1, len(nodes) - 1)
    a, b = corrections[after - 1], corrections[after]
    share = np.clip((frame - nodes[after - 1]) / (nodes[after] - nodes[after - 1]), 0.0, 1.0)
    between = np.asarray(se3_exp(share[:, None] * se3_log(jnp.asarray(inverse(a) @ b, jnp.float32))), np.float64)
    moved = a @ between @ T_world_cam
    moved[nodes] = smoothed
    return moved


def _image(run: SlamRun, i: int) -> RGBD:
    return RGBD.from_camera(*run.reader[run.frames[i].index])


def _controls(
    run: SlamRun, options: SlamOptions, nodes: Int[np.ndarray, "nodes"], count: int
) -> Float[Array, "steps controls"]:
    """Return the controls between frames: from the IMU where it is used, else zeros (constant velocity)."""
    sequence, steps = run.reader.sequence, list(pairwise(nodes))
    if not options.imu:
        return jnp.zeros((len(steps), count))
    assert sequence.T_body_cam is not None
    imu = ImuControl(sequence.imu, sequence.T_body_cam, run.frames[nodes[0]].time)
    between = [imu(run.poses[a], _velocity(run, a)[3:], run.times[a], run.times[b]) for a, b in steps]
    return jnp.asarray(between, jnp.float32)


def _velocity(run: SlamRun, i: int) -> np.ndarray:
    found = run.frames[i].velocity
    return np.zeros(6) if found is None else found


def _with_sensor_errors(found: Smoothed, prism: Prism) -> Float[np.ndarray, "nodes 12 12"]:
    """Return the covariances with the errors of stamps, calibration and scale, which all images share."""
    first = jax.tree.map(lambda leaf: leaf[0], found.states)
    start = prism.transition.manifold.pose(first)[:3, 3]
    beliefs = jax.vmap(rigid_belief)(found.states, jnp.asarray(found.covariance, jnp.float32))
    added = jax.vmap(lambda belief: with_sensor_errors(belief, start, prism.transition, prism.config).covariance)
    return np.asarray(added(beliefs), np.float64)


def _mapped(
    run: SlamRun,
    prism: Prism,
    options: SlamOptions,
    accepted: np.ndarray,
    T_world_cam: np.ndarray,
    progress: OnProgress,
) -> VoxelMap:
    """Return the map of the accepted images at their poses."""
    m = options.prior().map
    assert m is not None
    for done, i in enumerate(accepted, 1):
        image, T = _image(run, int(i)), jnp.asarray(T_world_cam[i], jnp.float32)
        m, _ = rolling_window.followed(m, T[:3, 3], prism.config.window_margin)
        m = update(m, image.depth, image.rgb, T, prism.rig.camera, prism.config.update)
        progress("mapping", done, len(accepted))
    return m


def _pose_errors(T_world_cam: np.ndarray, covariance: np.ndarray, run: SlamRun, options: SlamOptions) -> PoseErrors:
    """Return the errors of some of the smoothed poses, in the world's tangent."""
    kept = np.unique(np.linspace(0, len(T_world_cam) - 1, STATED_POSES).round().astype(int))
    adjoint = np.asarray(se3_adjoint(jnp.asarray(T_world_cam[kept], jnp.float32)), np.float64)
    in_world = adjoint @ covariance[kept] @ np.swapaxes(adjoint, 1, 2)
    return PoseErrors.of(T_world_cam[kept], in_world, run.reader.camera, options.max_depth)
