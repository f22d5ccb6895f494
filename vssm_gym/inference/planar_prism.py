"""PRISM for a robot on a floor: ``q_t(z_t) ~ p(z_t | x_<=t, u_<t)`` over (x, y, heading) and ``q_t(M)`` (SPEC 3, 6).

The filter of :mod:`prism` with the planar robot's transition in place of the free rigid body: the command predicts the
pose (TNP-SM, 4.2), the image corrects it by MAP within the plane, and the closed-form update puts the image into the
map at the pose's mean. Its anchor is PRISM's: rendered from the map, the camera image taken there standing in for what
the map does not know. Three degrees of freedom and a known command hold where six and constant velocity do not: before
a bare wall, and in turns that start and end from one frame to the next.

The covariance is that against the map. What the map's own frame has drifted since the start is not in it.
"""

from dataclasses import dataclass, field

import equinox as eqx
from jaxtyping import Array, Float

from vssm_gym.emission import RGBD
from vssm_gym.geometry import planar_to_matrix
from vssm_gym.inference import anchor, map_update, tracking
from vssm_gym.inference.alignment import AlignConfig
from vssm_gym.inference.anchor import Anchor
from vssm_gym.inference.map_update import MapUpdateConfig
from vssm_gym.inference.tracking import RobotRig, TrackerConfig, TrackerInfo, TrackerState
from vssm_gym.transition import MotionNoise
from vssm_gym.voxel_map import VoxelMap


def _tracker() -> TrackerConfig:
    """Residuals as PRISM's: the reference was made a moment ago, from images of this drive."""
    align = AlignConfig(0.006, 0.001, edge=0.02, levels=(4, 2, 1), iterations=(6, 4, 4))
    return TrackerConfig(align=align)


@dataclass(frozen=True)
class PlanarPrismConfig:
    """What the filter is told."""

    tracker: TrackerConfig = field(default_factory=_tracker)
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    anchor_distance: float = 0.15  # m and
    anchor_angle: float = 0.15  # rad: the anchor serves until the camera is farther from it than either


class PlanarPrismState(eqx.Module):
    """What the next step needs."""

    map: VoxelMap  # q_t(M)
    tracked: TrackerState  # q_t(z_t)
    anchor: Anchor


DEFAULT = PlanarPrismConfig()


def init(
    m: VoxelMap, start: Float[Array, "3"], image: RGBD, rig: RobotRig, config: PlanarPrismConfig = DEFAULT
) -> PlanarPrismState:
    """The belief after the first image, taken at a known pose.

    Args:
        m: The map's prior; consumed.
        start: ``(x, y, heading)``, m and rad, of the robot in the map's frame.
        image: The first image.
        rig: The camera and its place on the robot.
        config: Noise and effort.
    """
    tracked = tracking.first(start, image)
    T = planar_to_matrix(tracked.planar) @ rig.T_body_cam
    m = map_update.update(m, image.depth, image.rgb, T, rig.camera, config.update)
    return PlanarPrismState(m, tracked, anchor.take(m, T, image, rig.camera, config.update.max_depth, False))


def step(
    state: PlanarPrismState,
    control: Float[Array, "3"],
    image: RGBD,
    rig: RobotRig,
    noise: MotionNoise,
    config: PlanarPrismConfig = DEFAULT,
) -> tuple[PlanarPrismState, TrackerInfo]:
    """``q_t-1(z) q_t-1(M) -> q_t(z) q_t(M)``. The state passed in is consumed (the map is updated in place).

    An image that does not fit leaves the map as it is, and the pose follows the command; the next ones are compared
    with the map as rendered where the robot is expected to be, until one fits.

    Args:
        state: After the last image.
        control: ``(turn, offset, step)`` commanded since.
        image: The new image.
        rig: The camera and its place on the robot.
        noise: Execution noise of the motion model.
        config: Noise and effort.

    Returns:
        The next state and how the step went; ``info.status`` is a key of :data:`tracking.STATUS`.
    """
    if state.tracked.lost:
        tracked, info = tracking.step_map(state.tracked, control, image, state.map, rig, noise, config.tracker)
    else:
        predicted, _ = tracking.predict(state.tracked.belief, control, noise, rig)
        against = state.anchor
        tracked, info = tracking.correct(
            state.tracked, predicted, against.image, against.T_world_cam, image, rig, config.tracker, against.seen
        )
    if tracked.lost:
        return PlanarPrismState(state.map, tracked, state.anchor), info
    T = planar_to_matrix(tracked.planar) @ rig.T_body_cam
    m = map_update.update(state.map, image.depth, image.rgb, T, rig.camera, config.update)
    against = state.anchor
    if state.tracked.lost or anchor.left(against, T, config.anchor_distance, config.anchor_angle):
        against = anchor.take(m, T, image, rig.camera, config.update.max_depth, False)
    return PlanarPrismState(m, tracked, against), info
