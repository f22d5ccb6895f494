"""Smooth a trajectory by Gauss-Newton on the joint posterior of all its poses, the map integrated out (ours).

Each iteration draws new elements of the surfaces (reconstruction sampling), compares all images at them
(:mod:`~vssm_gym.inference.smoothing.agreement`), adds the transition (:mod:`~vssm_gym.inference.smoothing.chain`), and
solves for all poses at once. An iteration that has converged still errs by its draw, so that the last ones are averaged
(Polyak and Juditsky, SIAM J. Control Optim. 1992). It starts from a filter's trajectory and takes each image's own
information into account once, where the filter aligned every image to a map that the images before had written.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.geometry.colour_camera import ColourCamera
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.smoothing.agreement import NormalEquations, normal_equations
from vssm_gym.inference.smoothing.chain import PoseEquations, chain_equations, of_poses
from vssm_gym.inference.smoothing.views import StackedViews, draw_elements
from vssm_gym.inference.tracking.camera_filter import camera_twists
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import Manifold


@dataclass(frozen=True)
class SmoothingConfig:
    """Configure effort, and the weights of images.

    Args:
        align: standard deviations and weights of readings and colours.
        elements: drawn in each iteration.
        gates: m, within which the planes of images may belong to one element, of each iteration.
        averaged: last iterations of which the mean is taken; windows, which are small, keep the last one.
    """

    align: AlignConfig = field(default_factory=AlignConfig)
    elements: int = 8000
    gates: tuple[float, ...] = (0.1,) * 2 + (0.05,) * 8
    averaged: int = 6

    def __post_init__(self) -> None:
        if not self.gates:
            raise InputError("SmoothingConfig", "gates", "one for each iteration, at least one")
        if self.averaged < 1:
            raise InputError("SmoothingConfig", "averaged", f"at least 1, not {self.averaged}")


class _Iteration(NamedTuple):
    """Hold what an iteration has found."""

    states: Any
    theta: Float[np.ndarray, "shared"]  # of the calibration, its difference from the stated one
    hessian: Float[np.ndarray, "n n"]  # of the images' cost
    parts: Float[np.ndarray, "regions n"]  # of its gradient


class ColourPrior(NamedTuple):
    """Hold what is known about the colour camera's calibration: independent Gaussians about the stated one."""

    stated: ColourCamera  # at the size of the views
    std: Float[np.ndarray, "10"]  # of its parameters


class Smoothed(NamedTuple):
    """Hold ``q(z_1:T)``: the states and the covariance of each one's error."""

    states: Any  # a pytree with a leading time axis
    covariance: Float[np.ndarray, "time n n"]
    costs: list[float]  # of each iteration, before it
    colour: ColourCamera | None = None  # as learned; None where it was not asked for
    colour_covariance: Float[np.ndarray, "10 10"] | None = None  # of its parameters' errors


def smooth(
    key: PRNGKeyArray,
    views: StackedViews,
    rig: Rig,
    transition: Transition,
    start: GaussianBelief,
    states: Any,
    controls: Float[Array, "steps control"],
    dt: Float[Array, "steps"],
    config: SmoothingConfig = SmoothingConfig(),
    on_iteration: Callable[[int, float], None] | None = None,
    colour_prior: ColourPrior | None = None,
) -> Smoothed:
    """``argmax p(z_1:T | x_1:T, u_1:T-1)``, and the covariance of its Laplace approximation.

    With ``colour_prior``, the calibration of the views' colour camera is found with the poses.

    Args:
        key: random key, of the elements.
        views: an image for each state; one without planes says nothing.
        rig: the camera and its pose on the body.
        transition: how the body moves.
        start: ``p(z_1)``, which fixes the frame.
        states: a filter's estimate, a pytree with a leading time axis.
        controls: of each step.
        dt: length of each step, s.
        config: effort and weights.
        on_iteration: called with the number of an iteration and its cost.
        colour_prior: over the calibration, which starts from that of the views; None: that one is exact.

    Raises:
        InputError: not one image for each state, no image with a surface, or no colour camera to calibrate.
    """
    time = len(jax.tree.leaves(states)[0])
    if len(views.luminance) != time:
        raise InputError("smooth", "views", f"{time} images, one for each state; found {len(views.luminance)}")
    if not len(views.pixels):
        raise InputError("smooth", "views", "images that show a surface")
    if colour_prior is not None and views.colour is None:
        raise InputError("smooth", "views", "images of a colour camera apart, to learn its calibration")
    manifold, twists = transition.manifold, np.asarray(camera_twists(transition.manifold, rig), np.float64)
    p, n = twists.shape[1], len(manifold.turns)
    prior, theta = np.zeros(0), np.zeros(0)  # precision of the calibration, and its difference from the stated one
    if colour_prior is not None and views.colour is not None:
        prior, theta = np.asarray(colour_prior.std, np.float64) ** -2.0, colour_prior.stated.difference(views.colour)
    costs: list[float] = []
    last: list[_Iteration] = []
    for k, gate in enumerate(config.gates):
        T_world_cam = manifold.pose(states) @ rig.T_body_cam
        elements = draw_elements(jax.random.fold_in(key, k), views, T_world_cam, config.elements)
        seen = normal_equations(views, T_world_cam, elements, config.align, jnp.float32(gate))
        hessian, gradient, parts = of_bodies(
            seen, twists, len(views.pixels) / config.align.pixels_per_datum, len(prior)
        )
        chain = of_poses(chain_equations(transition, start, states, controls, dt), p)
        known = scipy.linalg.block_diag(chain.hessian, np.diag(prior))
        H = hessian + known
        step = -scipy.linalg.solve(
            H, gradient + np.append(chain.gradient, prior * theta), assume_a="pos", check_finite=False
        )
        costs.append(float(seen.cost))
        xi, change = np.split(step, [time * p])
        errors = np.concatenate([xi.reshape(time, p), (chain.rest + chain.by_poses @ xi).reshape(time, n - p)], axis=1)
        states = manifold.perturb(states, jnp.asarray(errors, jnp.float32))
        if colour_prior is not None and views.colour is not None:
            calibrated = views.colour.moved(change)
            views, theta = replace(views, colour=calibrated), colour_prior.stated.difference(calibrated)
        last = [*last, _Iteration(states, theta, hessian, parts)][-config.averaged :]
        if on_iteration:
            on_iteration(k, costs[-1])
    hessian, parts = (np.mean([getattr(one, name) for one in last], axis=0) for name in ("hessian", "parts"))
    errors = estimate_covariance(hessian + known, parts, known)
    states = mean_states(manifold, [one.states for one in last])
    found = Smoothed(states, covariances(errors[: time * p, : time * p], chain, time), costs)
    if colour_prior is None:
        return found
    calibrated = colour_prior.stated.moved(np.mean([one.theta for one in last], axis=0))
    return found._replace(colour=calibrated, colour_covariance=errors[time * p :, time * p :])


def mean_states(manifold: Manifold, states: list[Any]) -> Any:
    """Return the mean of states that are near each other, in the tangent of the last.

    Args:
        manifold: of the states.
        states: each a pytree with leading axes.
    """
    errors = jnp.stack([manifold.error(states[-1], one) for one in states])
    return manifold.perturb(states[-1], jnp.mean(errors, axis=0))


def of_bodies(seen: NormalEquations, twists: np.ndarray, data: float, shared: int) -> tuple[np.ndarray, ...]:
    """Return Hessian, gradient and its parts by region of the images' cost.

    They are by the coordinates of the bodies' poses, and then by the ``shared`` parameters of the colour camera.

    Args:
        seen: by the twists of the cameras, a sample of the pairs of an image and an element.
        twists: ``(6, p)`` of the camera, by the coordinates of a pose.
        data: independent readings of all images together: neighbouring pixels err alike.
        shared: number of parameters of the colour camera that are not known; 0 or all.
    """
    share = data / max(float(seen.pairs), 1.0)
    hessian = np.einsum("ip,tisj,jq->tpsq", twists, np.asarray(seen.hessian, np.float64), twists, optimize=True)
    gradient = np.asarray(seen.gradient, np.float64) @ twists
    parts = np.asarray(seen.by_region, np.float64) @ twists
    hessian, gradient = hessian.reshape(gradient.size, gradient.size), gradient.reshape(-1)
    parts = parts.reshape(len(parts), -1)
    if shared and seen.border is not None:
        own, g, by_region, with_poses = (np.asarray(part, np.float64) for part in seen.border)
        beside = np.einsum("ip,tik->tpk", twists, with_poses).reshape(len(gradient), -1)
        hessian = np.block([[hessian, beside], [beside.T, own]])
        gradient, parts = np.append(gradient, g), np.concatenate([parts, by_region], axis=1)
    return share * hessian, share * gradient, share * parts


def estimate_covariance(H: np.ndarray, parts: np.ndarray, known: np.ndarray) -> np.ndarray:
    """``H^-1 (sum_c g_c g_c^T + P) H^-1``: the covariance of the estimate, errors within a region c being as one.

    The residuals of a surface err alike in all images that see it, so that their number says little. What the parts of
    the gradient by region differ by says how large the errors are; P is the precision of the transition and of priors.
    """
    inverse = np.linalg.inv(H)
    spread = parts @ inverse
    return spread.T @ spread + inverse @ known @ inverse


def covariances(poses: np.ndarray, chain: PoseEquations, time: int) -> Float[np.ndarray, "time n n"]:
    """Return the covariance of each state, by that of the poses."""
    p, r = len(poses) // time, len(chain.rest) // time
    across = chain.by_poses @ poses
    covariance = np.zeros((time, p + r, p + r))
    for t in range(time):
        a, b = slice(p * t, p * (t + 1)), slice(r * t, r * (t + 1))
        covariance[t, :p, :p], covariance[t, p:, :p] = poses[a, a], across[b, a]
        covariance[t, :p, p:] = across[b, a].T
        covariance[t, p:, p:] = chain.rest_covariance[t] + across[b] @ chain.by_poses[b].T
    return covariance
