"""Hold what :class:`~vssm_gym.inference.smoothing.online.OnlineSmoother` knows between two images.

What images tell is relative: where steps are to each other. A :class:`Frame` is the pose that others are known relative
to, with its own covariance in the world, which moves all of them alike.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.transforms import inverse, se3_adjoint
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.smoothing.window import Step, View
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.map_samples import MeasurementNoise
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import RIGID, RigidState

SAME_VIEW_TURN = 0.5  # rad by which a view differs from another as much as by a metre
OF_POSE = 6  # coordinates of a pose, the first ones of a state


class Placed(NamedTuple):
    """Hold a step with what belongs to it besides."""

    step: Step
    image: RGBD | None  # at the camera's size, for the map; None: not accepted
    covariance: Float[np.ndarray, "n n"]  # of the state, in the world


class Earlier(NamedTuple):
    """Hold an earlier image that stays."""

    view: View
    T_world_cam: Float[np.ndarray, "4 4"]
    frame: "Frame"  # of its own pose


class Frame(NamedTuple):
    """Hold a pose whose own error moves alike all that is known relative to it."""

    T_world_body: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "p p"]  # of the pose, in the world


class OnlineState(eqx.Module):
    """Hold what the next step needs."""

    map: VoxelMap
    window: tuple[Placed, ...]  # the oldest first
    before: GaussianBelief  # over the state of the oldest, relative to ``frame``
    frame: Frame  # where the window began
    accepted: Frame  # of the last accepted image
    earlier: tuple[Earlier, ...]
    belief: GaussianBelief  # over the newest state, as seen from the last accepted image
    last: ReferenceView  # the last accepted image, at tracking size
    start: Float[Array, "3"]  # m, of the body at the first image
    lost: bool  # the last image was not accepted
    key: PRNGKeyArray
    measurement_noise: MeasurementNoise


def frame_of(placed: Placed) -> Frame:
    """Return the pose of a step, with its covariance."""
    return Frame(np.asarray(placed.step.state.T_world_body, np.float64), placed.covariance[:OF_POSE, :OF_POSE])


def carried(state: RigidState, frame: Frame) -> Float[np.ndarray, "p p"]:
    """Return the covariance of the pose of a state that moves with a frame: ``Ad Sigma Ad^T``."""
    between = inverse(np.asarray(state.T_world_body, np.float64)) @ frame.T_world_body
    adjoint = np.asarray(se3_adjoint(jnp.asarray(between, jnp.float32)), np.float64)
    return adjoint @ frame.covariance @ adjoint.T


def in_world(state: RigidState, covariance: np.ndarray, frame: Frame) -> np.ndarray:
    """Return the covariance in the world of a state that is known relative to a frame."""
    wider = np.array(covariance, np.float64)
    wider[:OF_POSE, :OF_POSE] += carried(state, frame)
    return wider


def seen_from_itself(placed: Placed) -> GaussianBelief:
    """Return the belief of one who knows the pose of a step, and the rest of its state as well as it is known."""
    covariance = placed.covariance.copy()
    covariance[:OF_POSE], covariance[:, :OF_POSE] = 0.0, 0.0
    return GaussianBelief(placed.step.state, jnp.asarray(covariance, jnp.float32), RIGID)


def newest_belief(state: OnlineState) -> GaussianBelief:
    """Return the belief over the newest state, in the world."""
    return replace(state.belief, covariance=jnp.asarray(state.window[-1].covariance, jnp.float32))


def apart(one: Earlier, T_world_cam: Float[np.ndarray, "4 4"]) -> float:
    """Return how much two views differ, m: the distance, and the angle by which the camera turned."""
    R = one.T_world_cam[:3, :3].T @ T_world_cam[:3, :3]
    angle = np.arccos(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0))
    return float(np.linalg.norm(one.T_world_cam[:3, 3] - T_world_cam[:3, 3]) + angle / SAME_VIEW_TURN)
