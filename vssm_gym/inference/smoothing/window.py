"""Smooth the newest images of a run together, against earlier ones that stay (ours).

    argmin_xi  1/2 sum_v sum_t w_tv (r_tv + J_tv xi_t - m_v(xi))^2 - sum_t log p(z_t | z_t-1, u_t-1)

The images' part is that of :mod:`~vssm_gym.inference.smoothing.agreement`, the map integrated out, over the images of
the window and of earlier steps that see the same surfaces; the errors of the latter are zero.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, Int

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.residuals import AlignConfig, luminance
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.smoothing.agreement import normal_equations
from vssm_gym.inference.smoothing.chain import chain_equations, of_poses
from vssm_gym.inference.smoothing.gauss_newton import SmoothingConfig, covariances, estimate_covariance, of_bodies
from vssm_gym.inference.smoothing.views import StackedViews, elements_at, planes
from vssm_gym.inference.tracking.camera_filter import camera_twists
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief


class View(NamedTuple):
    """Hold what is kept of one image."""

    plane: Float[Array, "height width 4"]  # as of StackedViews
    luminance: Float[Array, "height width"]
    pixels: Int[np.ndarray, "pixels"]  # numbers of those that have a plane; empty for an image that says nothing


class Step(NamedTuple):
    """Hold a time step of the window."""

    state: Any  # of the transition, one
    view: View
    control: Float[Array, "control"]  # that led here from the step before; not read of the first step
    dt: float  # s since then


class SmoothedWindow(NamedTuple):
    """Hold the window after an iteration or more."""

    states: list[Any]
    covariance: Float[np.ndarray, "time n n"]  # where the earlier images stay and the first state has its prior
    shared: float  # share of the drawn elements that the newest image sees, and another one
    held_shares: list[float]  # the same of each earlier image


def view_of(image: RGBD, camera: Camera, align: AlignConfig) -> View:
    """Return what is kept of an image.

    Args:
        image: of the camera.
        camera: intrinsics and size.
        align: standard deviations of its readings.
    """
    plane = planes(image.depth, camera, align.geo_sigma, align.geo_sigma_quadratic)
    return View(plane, luminance(image.rgb), np.flatnonzero(np.asarray(plane[..., :3].any(axis=-1))))


def without_image(camera: Camera) -> View:
    """Return a view that says nothing."""
    size = (camera.height, camera.width)
    return View(jnp.zeros((*size, 4)), jnp.zeros(size), np.zeros(0, int))


def smooth_window(
    rng: np.random.Generator,
    steps: list[Step],
    free: int,
    earlier: list[tuple[View, Float[np.ndarray, "4 4"]]],
    held: int,
    rig: Rig,
    transition: Transition,
    start: GaussianBelief,
    config: SmoothingConfig,
) -> SmoothedWindow:
    """Find the states of a window by Gauss-Newton, an iteration for each gate.

    Args:
        rng: of the elements.
        steps: the window, at most ``free``.
        free: for which the functions are compiled.
        earlier: views and ``T_world_cam`` of images that stay, at most ``held``.
        held: for which the functions are compiled.
        rig: the camera and its pose on the body.
        transition: how the body moves.
        start: over the state of the first step.
        config: effort and weights.
    """
    nothing, manifold = without_image(rig.camera), transition.manifold
    views = [step.view for step in steps] + [nothing] * (free - len(steps))
    views += [view for view, _ in earlier] + [nothing] * (held - len(earlier))
    stacked = StackedViews(
        jnp.stack([view.plane for view in views]),
        jnp.stack([view.luminance for view in views]),
        jnp.zeros(0, jnp.int32),
        rig.camera,
    )
    T_earlier = jnp.asarray([T for _, T in earlier] + [np.eye(4)] * (held - len(earlier)), jnp.float32)
    readings = sum(len(view.pixels) for view in views)
    twists = np.asarray(camera_twists(manifold, rig), np.float64)
    time, p, n = len(steps), twists.shape[1], len(manifold.turns)
    data = readings / config.align.pixels_per_datum
    states = _stacked([step.state for step in steps], free)
    controls = jnp.stack([step.control for step in steps[1:]])
    dt = jnp.asarray([step.dt for step in steps[1:]], jnp.float32)
    for gate in config.gates:
        T_world_cam = jnp.concatenate([_camera_poses(transition, states, rig), T_earlier])
        image, pixel = _drawn(rng, views, config.elements)
        elements = elements_at(stacked, T_world_cam, jnp.asarray(image), jnp.asarray(pixel))
        seen = normal_equations(stacked, T_world_cam, elements, config.align, jnp.float32(gate))
        H, gradient, parts = of_bodies(seen, twists, data, shared=0)
        H, gradient, parts = H[: time * p, : time * p], gradient[: time * p], parts[:, : time * p]
        now = jax.tree.map(lambda leaf: leaf[:time], states)
        chain = of_poses(chain_equations(transition, start, now, controls, dt), p)
        H = H + chain.hessian
        xi = -scipy.linalg.solve(H, gradient + chain.gradient, assume_a="pos", check_finite=False)
        errors = np.zeros((free, n))
        errors[:time, :p] = xi.reshape(time, p)
        errors[:time, p:] = (chain.rest + chain.by_poses @ xi).reshape(time, n - p)
        states = _perturbed(transition, states, jnp.asarray(errors, jnp.float32))
    shares = np.asarray(seen.by_image) / config.elements
    found = [jax.tree.map(lambda leaf, t=t: leaf[t], states) for t in range(time)]
    held_shares = shares[free : free + len(earlier)].tolist()
    errors = estimate_covariance(H, parts, chain.hessian)
    return SmoothedWindow(found, covariances(errors, chain, time), float(shares[time - 1]), held_shares)


def _drawn(rng: np.random.Generator, views: list[View], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw pixels that have a plane, all equally likely; return numbers of images and of pixels in them."""
    ends = np.cumsum([len(view.pixels) for view in views])
    drawn = rng.integers(0, max(int(ends[-1]), 1), count)
    image = np.searchsorted(ends, drawn, side="right")
    pixels = np.concatenate([view.pixels for view in views])
    return image, pixels[drawn]


def _stacked(states: list[Any], count: int) -> Any:
    """Return states with a leading axis of ``count``, the last one repeated."""
    return jax.tree.map(lambda *leaves: jnp.stack([*leaves, *[leaves[-1]] * (count - len(leaves))]), *states)


@eqx.filter_jit
def _camera_poses(transition: Transition, states: Any, rig: Rig) -> Float[Array, "time 4 4"]:
    return transition.manifold.pose(states) @ rig.T_body_cam


@eqx.filter_jit
def _perturbed(transition: Transition, states: Any, errors: Float[Array, "time n"]) -> Any:
    return transition.manifold.perturb(states, errors)
