"""Make the reference view: the RGB-D image that poses are aligned to, rendered from the map (PRISM).

Geometry comes from the map alone. Colour has two sources: the rendered image, which does not drift but is as coarse as
the cells, and the camera image taken at the same pose, which is sharp. Where a cell around a pixel's surface is
unobserved, the camera image replaces the rendered one; pixels beside such a seam are left out.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_log
from vssm_gym.inference.alignment.residuals import luminance
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission, emission_uncertainty
from vssm_gym.model.emission import RGBD

# Standard deviations of the displacement of a surface; chosen on the scenes for training.
LEARNED = 0.12  # cells, in a map learned before
JUST_WRITTEN = 0.05  # cells, in a map that was written from about the same place
TAKEN = 0.0006  # m, in a camera image


class ReferenceView(eqx.Module):
    """Hold the view that the next images are aligned to."""

    T_world_cam: Float[Array, "4 4"]
    image: RGBD  # rendered from the map mean, unknown pixels from the camera image
    seen: Float[Array, "height width"] | None  # luminance of the camera image taken there, [0, 1]; None: none was
    spread: Float[Array, "height width"] | None  # m, std of the rendered depth under q(M); None: the mean is taken
    displacement: Float[Array, ""]  # m, std of the error that a whole surface has in common


@jax.jit
def _combine(m: VoxelMap, T_world_cam: Array, camera: Camera, rendered: RGBD, taken: RGBD) -> tuple[RGBD, Array]:
    # A cell that was never observed has the prior's colour; next to it a bare wall would have an edge.
    points = camera.backproject(rendered.depth) @ T_world_cam[:3, :3].T + T_world_cam[:3, 3]
    known = rendered.known & (m.observed_at(points) > 0.999)
    seam = jnp.zeros_like(known)
    for axis in (0, 1):
        for by in (1, -1):
            seam |= jnp.roll(known, by, axis) != known
    image = RGBD(
        depth=jnp.where(known, rendered.depth, taken.depth),
        rgb=jnp.where(known[..., None], rendered.rgb, taken.rgb),
        hit=jnp.where(known, rendered.hit, taken.hit),
        # Where the two sources meet, steps of depth and colour are not those of the scene; what is unknown has no
        # neighbours either.
        known=known | (taken.known & ~seam),
    )
    return image, luminance(taken.rgb)


_depth_std = jax.jit(lambda m, T, camera, image: emission_uncertainty.image_std(m, T, camera, image)[0])


def from_image(
    m: VoxelMap, T_world_cam: Float[Array, "4 4"], taken: RGBD, camera: Camera, max_depth: float, expected: bool
) -> ReferenceView:
    """Make the reference view at a pose whose image has just entered the map (eq. I25).

    Args:
        m: The map.
        T_world_cam: The pose.
        taken: The camera image taken there.
        camera: Its intrinsics.
        max_depth: Of the rendering, m.
        expected: True: the map's uncertainty widens the residuals (an expectation over ``q(M)``, to first order);
            False: the map's mean is used as if it were certain.
    """
    rendered = emission.render(m, T_world_cam, camera, max_depth)
    image, seen = _combine(m, T_world_cam, camera, rendered, taken)
    spread = None
    if expected:
        std = _depth_std(m, T_world_cam, camera, rendered)
        spread = jnp.where(rendered.known, std, 0.0)  # a camera image's own noise is in the residual's scale
    return ReferenceView(T_world_cam, image, seen, spread, jnp.float32(JUST_WRITTEN * m.voxel_size))


def from_map(m: VoxelMap, T_world_cam: Float[Array, "4 4"], camera: Camera, max_depth: float) -> ReferenceView:
    """Render the reference view at a pose without a camera image, from the map alone."""
    image = emission.render(m, T_world_cam, camera, max_depth)
    return ReferenceView(T_world_cam, image, None, None, jnp.float32(LEARNED * m.voxel_size))


def of_image(T_world_cam: Float[Array, "4 4"], taken: RGBD) -> ReferenceView:
    """Make the reference view of a camera image alone, at the pose where it is believed to be taken."""
    return ReferenceView(T_world_cam, taken, None, None, jnp.float32(TAKEN))


@jax.jit
def has_left(
    reference: ReferenceView, T_world_cam: Float[Array, "4 4"], distance: float | Array, angle: float | Array
) -> Bool[Array, ""]:
    """Return True if a camera is at least ``distance`` (m) or ``angle`` (rad) away from its reference view."""
    xi = se3_log(inverse(reference.T_world_cam) @ T_world_cam)
    return (jnp.linalg.norm(xi[:3]) >= distance) | (jnp.linalg.norm(xi[3:]) >= angle)
