"""Frame-to-model SLAM of a hand-held RGB-D camera: MAP pose, then the closed-form map update (SPEC 3, steps 2 and 5).

Each frame starts with the rotation that best carries the last image onto it (small images, no geometry), then aligns
to the map rendered at the last pose, whose holes are filled from the last image: where the view is new, the last image
is the only reference there is. Frames that do not fit are said to be lost and do not touch the map.
"""

from dataclasses import dataclass, field, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vssm_gym import emission
from vssm_gym.camera import Camera
from vssm_gym.emission import RGBD
from vssm_gym.inference import map_update
from vssm_gym.inference.alignment import AlignConfig, AlignInfo, align
from vssm_gym.inference.map_update import MapUpdateConfig
from vssm_gym.voxel_map import VoxelMap

OK, LOST = 0, 1
STATUS = {OK: "ok", LOST: "lost track: the image fits neither the map nor the last image"}


@dataclass(frozen=True)
class SlamConfig:
    """Alignment, prior and loss test of the first SLAM loop."""

    align: AlignConfig = field(default_factory=lambda: AlignConfig(levels=(2, 1), iterations=(6, 5)))
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    pose_std: tuple[float, ...] = (0.05, 0.05, 0.05, 0.03, 0.03, 0.03)  # of the motion beyond the rotation found first
    rotation_sizes: tuple[int, ...] = (20, 40, 80)  # image widths of the rotation search
    rotation_iterations: int = 8  # per size
    min_score: float = 0.6  # inlier share times min(1, coverage / 0.4)
    max_photometric: float = 5.0  # mean |r_rgb| / sigma; cells of 7 cm blur the rendered image by that much


class SlamState(eqx.Module):
    """What the next frame needs."""

    map: VoxelMap
    T_world_cam: Float[Array, "4 4"]  # pose of the last frame that fitted
    image: RGBD  # the last frame that fitted


class SlamInfo(eqx.Module):
    """How a frame went."""

    status: Int[Array, ""]  # a key of STATUS
    T_world_cam: Float[Array, "4 4"]  # the frame's pose; where lost, the last one turned by the rotation found
    agreement: AlignInfo


def camera_rotation(image: RGBD, last: RGBD, camera: Camera, config: SlamConfig) -> Float[Array, "4 4"]:
    """``argmin_R sum rho(I_last[pi(R p)] - I[pi(p)])``: T_last_cam of a pure rotation, on small images.

    A rotation moves pixels by a homography whatever their depth, so both images are given the depth 1.
    """
    factors = tuple(max(1, camera.width // size) for size in config.rotation_sizes)
    flat = replace(
        config.align,
        geo_sigma=1e3,  # the plane at depth 1 is a device, not data
        geo_gate=1e3,
        levels=factors,
        iterations=(config.rotation_iterations,) * len(factors),
    )
    everywhere = jnp.ones_like(image.hit)

    def unit(image):
        return RGBD(jnp.ones_like(image.depth), image.rgb, everywhere, everywhere)

    identity, rotations = jnp.eye(4), jnp.eye(6)[:, 3:]
    T, _ = align(identity, 1e-6 * jnp.eye(3), identity, rotations, unit(last), unit(image), camera, flat)
    return T


def filled(rendered: RGBD, last: RGBD) -> RGBD:
    """The rendered image with its unknown pixels taken from the last image, seen from the same pose."""
    known = rendered.known
    return RGBD(
        depth=jnp.where(known, rendered.depth, last.depth),
        rgb=jnp.where(known[..., None], rendered.rgb, last.rgb),
        hit=jnp.where(known, rendered.hit, last.hit),
        known=known | last.known,
    )


@partial(jax.jit, static_argnums=3, donate_argnums=0)
def init(m: VoxelMap, image: RGBD, camera: Camera, config: SlamConfig) -> SlamState:
    """The first frame, at the identity: the world is its camera's frame. The map passed in is consumed."""
    identity = jnp.eye(4, dtype=jnp.float32)
    m = map_update.update(m, image.depth, image.rgb, identity, camera, config.update)
    return SlamState(m, identity, image)


@partial(jax.jit, static_argnums=5)
def _localise(
    T_world_last: Array, last: RGBD, rendered: RGBD, image: RGBD, camera: Camera, config: SlamConfig
) -> tuple[Array, RGBD, Array, SlamInfo]:
    """The frame's pose: what the next frame starts from (pose, image), the depth to add to the map, and how it went."""
    turned = camera_rotation(image, last, camera, config)
    precision = jnp.diag(jnp.asarray(config.pose_std) ** -2)
    reference = filled(rendered, last)
    T, agreement = align(turned, precision, turned, jnp.eye(6), reference, image, camera, config.align)
    score = agreement.inlier_share * jnp.minimum(1.0, agreement.coverage / 0.4)
    fits = (score >= config.min_score) & (agreement.photometric <= config.max_photometric)
    T_world_cam = T_world_last @ jnp.where(fits, T, turned)
    # An image without depth updates no cell: a frame that does not fit leaves the map as it was.
    depth = jnp.where(fits, image.depth, 0.0)
    kept = jax.tree.map(lambda new, old: jnp.where(fits, new, old), (T_world_cam, image), (T_world_last, last))
    return *kept, depth, SlamInfo(jnp.where(fits, OK, LOST), T_world_cam, agreement)


def step(state: SlamState, image: RGBD, camera: Camera, config: SlamConfig) -> tuple[SlamState, SlamInfo]:
    """Localise one frame against the map and add it. The state passed in is consumed (the map is updated in place).

    Args:
        state: After the last frame.
        image: The new frame.
        camera: Its intrinsics.
        config: Scales, gates, effort.

    Returns:
        The next state and how the frame went.
    """
    # Three compiled calls, for the reason given in `tracking.step_map`.
    rendered = emission.render(state.map, state.T_world_cam, camera, config.update.max_depth)
    T_world_cam, kept, depth, info = _localise(state.T_world_cam, state.image, rendered, image, camera, config)
    m = map_update.update(state.map, depth, image.rgb, info.T_world_cam, camera, config.update)
    return SlamState(m, T_world_cam, kept), info
