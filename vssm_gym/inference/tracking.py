"""Real-time localisation of a planar robot: MAP of SPEC 3 step 2 with the dynamics prior of SPEC 6 (TNP-SM, 4.2).

Each step predicts the pose from the control, takes a reference image, and aligns the camera image to it:
:func:`step_map` renders the reference from a fixed map at the predicted pose; :func:`step_frames` takes the previous
camera image (the published "no map" baseline: its errors add up). Loss of track is detected and said; the belief then
follows the dynamics until images agree again.
"""

from dataclasses import dataclass, field
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from vssm_gym import emission
from vssm_gym.camera import Camera
from vssm_gym.emission import RGBD
from vssm_gym.geometry import inverse, matrix_to_planar, planar_to_matrix, se3_adjoint
from vssm_gym.inference.adam import AdamConfig, align_adam
from vssm_gym.inference.alignment import AlignConfig, AlignInfo, score
from vssm_gym.inference.gauss_newton import align
from vssm_gym.transition import MotionNoise, PlanarBelief, planar_predict
from vssm_gym.voxel_map import VoxelMap

OK, LOST = 0, 1
STATUS = {OK: "ok", LOST: "lost track: the camera image does not fit the reference"}
_PLANAR_TWISTS = np.eye(6)[:, [0, 1, 5]]  # forward, left, turn among (translation, rotation)


@dataclass(frozen=True)
class TrackerConfig:
    """Alignment and the test for loss of track."""

    align: AlignConfig = field(default=AlignConfig(geo_sigma=0.012))  # a map of 5 cm cells is that rough
    min_score: float = 0.5  # inlier share times min(1, coverage / 0.4) below this is lost
    max_photometric: float = 5.0  # mean |r_rgb| / sigma above this is lost
    process_std: tuple[float, float, float] = (0.004, 0.004, 0.002)  # what the motion model misses: slip at a contact
    adam: AdamConfig | None = None  # the published solver, in place of Gauss-Newton


class RobotRig(eqx.Module):
    """The camera on the robot."""

    camera: Camera
    T_body_cam: Float[Array, "4 4"]


class TrackerState(eqx.Module):
    """What the next step needs."""

    belief: PlanarBelief
    image: RGBD  # the last camera image
    lost: Int[Array, ""]  # steps since the images last agreed; 0 = tracking

    @property
    def planar(self) -> Float[Array, "3"]:
        """The estimate ``(x, y, heading)``, m and rad, world."""
        return self.belief.planar

    @property
    def covariance(self) -> Float[Array, "3 3"]:
        """Of ``(x, y, heading)`` in world axes."""
        c, s = jnp.cos(self.planar[2]), jnp.sin(self.planar[2])
        R = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return R @ self.belief.covariance @ R.T


class TrackerInfo(eqx.Module):
    """How a step went."""

    status: Int[Array, ""]  # a key of STATUS
    agreement: AlignInfo


def observe(rgb: np.ndarray, depth: np.ndarray) -> RGBD:
    """A camera image (uint8 colour, metres with 0 = no reading) as the model's."""
    metres = jnp.where(np.isfinite(depth), jnp.asarray(depth, jnp.float32), 0.0)
    return RGBD(metres, jnp.asarray(rgb, jnp.float32) / 255.0, metres > 0.0, metres > 0.0)


def first(start: Float[Array, "3"], image: RGBD, std: tuple[float, float, float] = (1e-3, 1e-3, 1e-3)) -> TrackerState:
    """The state at a known start pose ``(x, y, heading)`` with the image seen there."""
    covariance = jnp.diag(jnp.asarray(std, jnp.float32) ** 2)
    return TrackerState(PlanarBelief(jnp.asarray(start, jnp.float32), covariance), image, jnp.int32(0))


@partial(jax.jit, static_argnums=6)
def correct(
    state: TrackerState,
    predicted: PlanarBelief,
    reference: RGBD,
    T_world_ref: Float[Array, "4 4"],
    image: RGBD,
    rig: RobotRig,
    config: TrackerConfig,
    seen: Float[Array, "height width"] | None = None,
) -> tuple[TrackerState, TrackerInfo]:
    """Align the image to a reference and combine with the prediction; keep the prediction where they do not fit.

    ``seen`` is the luminance of the camera image taken where the reference was rendered; Gauss-Newton alone uses it.
    """
    basis = planar_basis(rig)
    T_ref_cam = inverse(T_world_ref) @ planar_to_matrix(predicted.planar) @ rig.T_body_cam
    problem = (T_ref_cam, prior_precision(predicted, config), T_ref_cam, basis, reference, image, rig.camera)
    if config.adam is None:
        T, agreement = align(*problem, config.align, seen=seen)
    else:
        # The same pixels at every step: a step stays a function of its arguments.
        T, agreement = align_adam(*problem, config.align, jax.random.key(0), config.adam)
    return conclude(state, predicted, T_world_ref @ T, agreement, image, rig, config)


def planar_basis(rig: RobotRig) -> Float[Array, "6 3"]:
    """The camera's twists when the body goes forward, left, and turns."""
    return se3_adjoint(inverse(rig.T_body_cam)) @ jnp.asarray(_PLANAR_TWISTS, jnp.float32)


def prior_precision(predicted: PlanarBelief, config: TrackerConfig) -> Float[Array, "3 3"]:
    """Of ``p(z_t | z_t-1, u_t-1)``, what the motion model misses included."""
    return jnp.linalg.inv(predicted.covariance + jnp.diag(jnp.asarray(config.process_std) ** 2))


def conclude(
    state: TrackerState,
    predicted: PlanarBelief,
    T_world_cam: Float[Array, "4 4"],
    agreement: AlignInfo,
    image: RGBD,
    rig: RobotRig,
    config: TrackerConfig,
) -> tuple[TrackerState, TrackerInfo]:
    """The belief at the MAP pose (Laplace, SPEC 3, step 3), or the prediction where the images do not agree there."""
    precision = prior_precision(predicted, config)
    fits = (score(agreement) >= config.min_score) & (agreement.photometric <= config.max_photometric)
    corrected = PlanarBelief(
        matrix_to_planar(T_world_cam @ inverse(rig.T_body_cam)),
        jnp.linalg.inv(2.0 * agreement.information + precision),
    )
    spread = predicted.covariance + jnp.diag(jnp.asarray(config.process_std) ** 2)
    belief = jax.tree.map(lambda a, b: jnp.where(fits, a, b), corrected, PlanarBelief(predicted.planar, spread))
    lost = jnp.where(fits, 0, state.lost + 1)
    return TrackerState(belief, image, lost), TrackerInfo(jnp.where(fits, OK, LOST), agreement)


@jax.jit
def predict(belief: PlanarBelief, control: Array, noise: MotionNoise, rig: RobotRig) -> tuple[PlanarBelief, Array]:
    """The belief after the control, and the camera's pose at its mean."""
    predicted = planar_predict(belief, control, noise)
    return predicted, planar_to_matrix(predicted.planar) @ rig.T_body_cam


def step_map(
    state: TrackerState,
    control: Float[Array, "3"],
    image: RGBD,
    m: VoxelMap,
    rig: RobotRig,
    noise: MotionNoise,
    config: TrackerConfig = TrackerConfig(),
) -> tuple[TrackerState, TrackerInfo]:
    """``argmax_z log p(x_t | z, M) + log p(z | z_t-1, u_t-1)`` against an image rendered at the predicted pose.

    Args:
        state: The belief after the last step.
        control: (turn, offset, step) commanded since.
        image: The camera image now.
        m: The map, fixed.
        rig: Camera and its place on the robot.
        noise: Execution noise of the motion model.
        config: Scales, gates, effort.

    Returns:
        The next state and how the step went; ``info.status`` is a key of :data:`STATUS`.
    """
    # Three compiled calls, not one: in one, the compiler fuses the renderer into each of the many places that read its
    # image and computes it again there (25 ms more a step; it ignores optimization barriers on the CPU).
    predicted, T_world_ref = predict(state.belief, control, noise, rig)
    reference = emission.render(m, T_world_ref, rig.camera)
    return correct(state, predicted, reference, T_world_ref, image, rig, config)


@partial(jax.jit, static_argnums=5)
def step_frames(
    state: TrackerState,
    control: Float[Array, "3"],
    image: RGBD,
    rig: RobotRig,
    noise: MotionNoise,
    config: TrackerConfig = TrackerConfig(),
) -> tuple[TrackerState, TrackerInfo]:
    """As :func:`step_map`, but against the previous camera image, at the previous estimate (TNP-SM, "no map").

    The images tell the step from there alone: what was uncertain before it stays so, and covariances add up.
    """
    planar = state.belief.planar
    predicted = planar_predict(PlanarBelief(planar, jnp.zeros((3, 3))), control, noise)
    T_world_ref = planar_to_matrix(planar) @ rig.T_body_cam
    moved, info = correct(state, predicted, state.image, T_world_ref, image, rig, config)
    carried = planar_predict(state.belief, control, MotionNoise(0.0, 0.0)).covariance
    belief = PlanarBelief(moved.belief.planar, carried + moved.belief.covariance)
    return TrackerState(belief, moved.image, moved.lost), info
