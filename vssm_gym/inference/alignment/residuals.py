"""``r_geo = <p^ - T p, n^>``, ``r_rgb = I^[pi(T p)] - I[pi(p)]``: residuals of the pose (PRISM, step 2).

An observed RGB-D image is aligned to a reference image, rendered from the map or taken earlier, by ``T = T_ref_cam``
and projective association; the image residual is on luminance. The solvers (:mod:`gauss_newton`, :mod:`adam`) minimise
``L_geo + L_rgb - log q(T)`` over motions in a subspace ``T = T_prior exp(B xi)``: ``B`` is the identity for a free
camera and the three planar twists for a robot on a floor, which then stays on it exactly.
"""

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_adjoint
from vssm_gym.model.emission import RGBD

FULL_COVERAGE = 0.4  # share of the image that suffices for a full score; chosen on hand-held recordings


@dataclass(frozen=True)
class AlignConfig:
    """Configure scales, gates and effort of the alignment (eq. I10)."""

    geo_sigma: float = 0.004  # m, of the point-to-plane residual at depth 0
    geo_sigma_quadratic: float = 0.0025  # 1/m: grows with depth squared, as a structured-light or stereo sensor's
    rgb_sigma: float = 0.04  # luminance in [0, 1]
    huber: float = 1.345  # elbow, in standard deviations
    geo_gate: float = 0.30  # m; pairs farther apart are different surfaces
    rgb_gate: float = 0.30  # luminance
    rgb_weight: float = 0.6  # of photometry against geometry
    seen_weight: float = 0.6  # of photometry against the image seen at the reference pose
    pixels_per_datum: float = 30.0  # pixels that count as one independent residual: neighbours have correlated errors
    pixels: int = 5000  # observed pixels used at most, on a regular grid
    levels: tuple[int, ...] = (4, 2, 1)  # image shrink factors, coarse to fine
    iterations: tuple[int, ...] = (6, 5, 5)  # at most, per level
    tolerance: float = 1e-5  # m and rad: a smaller step ends the level
    inlier: float = 2.5  # standard deviations: smaller residuals are inliers
    cost_limit: float = 3.0  # standard deviations, of a residual in the alignment cost
    unseen_cost: float = 2.0  # in the alignment cost, of a pixel that falls on nothing known: likelier than an outlier
    edge: float = 0.05  # relative depth jump to a neighbour that makes a reference pixel unusable


class ReferencePixels(eqx.Module):
    """Hold a plane and a linear approximation of the image for each reference pixel; zeros where there is none."""

    plane: Float[Array, "4 pixels"]  # unit normal and its offset <n, p>, camera frame; all 0 where unknown
    image: Float[Array, "3 pixels"]  # luminance and its two derivatives per pixel
    textured: Bool[Array, "pixels"]  # where the image is known
    seen: Float[Array, "3 pixels"] | None = None  # as ``image``, of the camera image taken at the reference pose
    spread: Float[Array, "pixels"] | None = None  # m, std of the planes under the map belief, without sensor noise


class ObservedPixels(eqx.Module):
    """Hold points and luminance of the observed image."""

    points: Float[Array, "3 pixels"]  # camera frame, m
    luminance: Float[Array, "pixels"]
    valid: Bool[Array, "pixels"]


class AlignInfo(eqx.Module):
    """Measure the fit quality of an alignment at its solution (eq. I15)."""

    inlier_share: Float[Array, ""]  # of the projected pixels with a plane: |r_geo| < AlignConfig.inlier sigma
    coverage: Float[Array, ""]  # share of observed pixels that fall on a reference plane
    photometric: Float[Array, ""]  # mean |r_rgb| / sigma
    information: Float[Array, "dof dof"]  # of the data about xi: sum J^T J of the scaled residuals, per datum
    iterations: Array  # on the finest level


def score(info: AlignInfo) -> Float[Array, ""]:
    """``inlier_share min(1, coverage / FULL_COVERAGE)``: near 1 where an image fits its reference (eq. I27).

    Chosen on hand-held recordings.

    0.4 is the coverage that images of one place still reach when the camera has left the reference view by the most
    that the filter allows; below it, few pixels could reach a high inlier share by chance.
    """
    return info.inlier_share * jnp.minimum(1.0, info.coverage / FULL_COVERAGE)


def luminance(rgb: Float[Array, "height width 3"]) -> Float[Array, "height width"]:
    """Return the mean of the colour channels, [0, 1] (eq. I8)."""
    # As a product it takes a quarter of the time of a reduction along so short an axis.
    return jnp.matmul(rgb, jnp.full(3, 1.0 / 3.0, rgb.dtype), precision="highest")


def shrink_depth(depth: Array, factor: int) -> Array:
    """Keep one depth reading of each ``factor x factor`` block: the pixel at its centre (rounded down-right)."""
    if factor == 1:
        return depth
    h, w = depth.shape[0] // factor, depth.shape[1] // factor
    o = factor // 2
    return depth[o : o + h * factor : factor, o : o + w * factor : factor]


def shrink_image(image: Array, factor: int) -> Array:
    """Average over ``factor x factor`` pixels."""
    if factor == 1:
        return image
    h, w = image.shape[0] // factor, image.shape[1] // factor
    return image[: h * factor, : w * factor].reshape(h, factor, w, factor).mean(axis=(1, 3))


def shrink_rgbd(image: RGBD, factor: int) -> RGBD:
    """Return the image at a smaller size, as a camera of that size would have it."""
    if factor == 1:
        return image
    rgb = jnp.stack([shrink_image(image.rgb[..., c], factor) for c in range(3)], axis=-1)
    return RGBD(
        shrink_depth(image.depth, factor), rgb, shrink_depth(image.hit, factor), shrink_depth(image.known, factor)
    )


def shrink_camera(camera: Camera, factor: int) -> Camera:
    """Return the camera whose pixels are the kept depth readings.

    A block's mean luminance belongs to the block's centre, up to a quarter of a shrunk pixel beside its kept reading.
    The offset is the same in both images, so that it does not bias the alignment.
    """
    if factor == 1:
        return camera
    o = factor // 2
    return Camera(
        camera.width // factor,
        camera.height // factor,
        camera.fx / factor,
        camera.fy / factor,
        (camera.cx - o) / factor,
        (camera.cy - o) / factor,
    )


def _linear(grey: Array) -> Array:
    """Return luminance and its central differences, ``(3, pixels)``."""
    du = 0.5 * (jnp.roll(grey, -1, 1) - jnp.roll(grey, 1, 1))
    dv = 0.5 * (jnp.roll(grey, -1, 0) - jnp.roll(grey, 1, 0))
    return jnp.stack([grey, du, dv]).reshape(3, -1)


def make_reference(
    image: RGBD,
    camera: Camera,
    config: AlignConfig,
    factor: int = 1,
    seen: Array | None = None,
    spread: Array | None = None,
) -> ReferencePixels:
    """Compute planes and image derivatives of an RGB-D image, shrunk by ``factor`` (eq. I7).

    Args:
        image: Rendered from the map, or taken.
        camera: Its intrinsics.
        config: Limits.
        factor: To shrink by.
        seen: Luminance of a camera image taken at the same pose.
        spread: Std of the image's depth, m.
    """
    depth = shrink_depth(jnp.where(image.known, image.depth, 0.0), factor)
    p = shrink_camera(camera, factor).backproject(depth)

    def sides(a, axis):
        return jnp.roll(a, -1, axis), jnp.roll(a, 1, axis)

    (right, left), (down, up) = sides(p, 1), sides(p, 0)
    normal = jnp.cross(down - up, right - left)
    length = jnp.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / jnp.maximum(length, 1e-12)
    limit = config.edge * depth * factor
    smooth = depth > 0.0
    for neighbour in (*sides(depth, 0), *sides(depth, 1)):
        # A depth that jumps on one side only (beyond the slope on the other) is an edge; a steep plane is not.
        smooth &= neighbour > 0.0
    for a, b in (sides(depth, 0), sides(depth, 1)):
        smooth &= jnp.abs(a + b - 2.0 * depth) < limit
    inner = jnp.zeros_like(smooth).at[1:-1, 1:-1].set(True)
    smooth = smooth & inner & (length[..., 0] > 1e-12)
    plane = jnp.concatenate([normal, jnp.sum(normal * p, -1, keepdims=True)], axis=-1)
    plane = jnp.where(smooth[..., None], plane, 0.0)
    grey = shrink_image(luminance(image.rgb), factor)
    known = shrink_image(image.known.astype(jnp.float32), factor) > 0.999
    textured = known & inner
    for neighbour in (*sides(known, 0), *sides(known, 1)):
        textured &= neighbour
    return ReferencePixels(
        plane=jnp.moveaxis(plane, -1, 0).reshape(4, -1),
        image=_linear(grey),
        textured=textured.reshape(-1),
        seen=None if seen is None else _linear(shrink_image(seen, factor)),
        spread=None if spread is None else shrink_depth(spread, factor).reshape(-1),
    )


def stride(camera: Camera, factor: int, config: AlignConfig) -> int:
    """Return the spacing of used pixels of the shrunk image, so that about ``config.pixels`` remain."""
    pixels = (camera.width // factor) * (camera.height // factor)
    return max(1, round((pixels / config.pixels) ** 0.5))


def make_observed(image: RGBD, camera: Camera, factor: int = 1, every: int = 1) -> ObservedPixels:
    """Compute points and luminance of an image, shrunk by ``factor``, at every ``every``-th row and column."""
    depth = shrink_depth(jnp.where(image.hit, image.depth, 0.0), factor)
    p = jnp.moveaxis(shrink_camera(camera, factor).backproject(depth), -1, 0)
    grey = shrink_image(luminance(image.rgb), factor)
    grid = (..., slice(every // 2, None, every), slice(every // 2, None, every))
    return ObservedPixels(p[grid].reshape(3, -1), grey[grid].reshape(-1), (depth[grid] > 0.0).reshape(-1))


class Term(NamedTuple):
    """Hold one kind of residual at a pose, in standard deviations."""

    residual: Float[Array, "pixels"]
    weight: Float[Array, "pixels"]  # Huber's, times the share of an independent datum; 0 where not used
    jacobian: Float[Array, "6 pixels"]  # by a twist d in the reference's frame, T' = exp(d) T
    usable: Bool[Array, "pixels"]  # falls on a plane (geometry), on a known part of the image (photometry)


def linearise(
    T: Float[Array, "4 4"], ref: ReferencePixels, obs: ObservedPixels, camera: Camera, factor: int, config: AlignConfig
) -> tuple[Term, ...]:
    """Linearise geometry, photometry and, where the reference has it, photometry against the camera image seen there.

    Args:
        T: T_ref_cam.
        ref: What is aligned to, shrunk by ``factor``.
        obs: What is aligned, likewise.
        camera: Of the images before shrinking.
        factor: They were shrunk by.
        config: Scales and gates.
    """
    view = shrink_camera(camera, factor)
    q = T[:3, :3] @ obs.points + T[:3, 3][:, None]
    ahead = obs.valid & (q[2] > 0.05)
    inverse_z = 1.0 / jnp.where(ahead, q[2], 1.0)
    u, v = q[0] * inverse_z * view.fx + view.cx, q[1] * inverse_z * view.fy + view.cy
    i, j = jnp.round(u), jnp.round(v)
    inside = ahead & (i >= 0) & (i < view.width) & (j >= 0) & (j < view.height)
    pixel = jnp.where(inside, j * view.width + i, 0.0).astype(jnp.int32)
    # One gather of whole rows: eight would each compute the projection again.
    images = [ref.image] if ref.seen is None else [ref.image, ref.seen]
    spread = [] if ref.spread is None else [ref.spread[None]]
    rows = jnp.concatenate([ref.plane, ref.textured[None].astype(ref.image.dtype), *images, *spread]).T
    nx, ny, nz, offset, textured, *linear = rows.at[pixel].get(mode="promise_in_bounds").T
    r_geo = offset - (nx * q[0] + ny * q[1] + nz * q[2])
    planar = inside & (nx * nx + ny * ny + nz * nz > 0.5)
    known = inside & (textured > 0.5)
    near = jnp.abs(r_geo) < config.geo_gate
    depth = obs.points[2]
    sigma_geo = config.geo_sigma + config.geo_sigma_quadratic * depth * depth
    if ref.spread is not None:
        sigma_geo = jnp.hypot(sigma_geo, linear.pop())
    scale_geo = 1.0 / sigma_geo
    scale_rgb = 1.0 / config.rgb_sigma
    share = (factor * stride(camera, factor, config)) ** 2 / config.pixels_per_datum

    def term(residual, use, scale, share, x, y, z, usable):
        """Scale a residual with gradient ``x, y, z`` by the point q, which exp(d) moves by d_t + d_r x q."""
        s = residual * scale
        weight = share * use * jnp.minimum(1.0, config.huber / jnp.maximum(jnp.abs(s), 1e-9))
        x, y, z = x * scale, y * scale, z * scale
        J = jnp.stack([x, y, z, q[1] * z - q[2] * y, q[2] * x - q[0] * z, q[0] * y - q[1] * x])
        return Term(s, weight, J, usable)

    inner = inside & (i > 0) & (i < view.width - 1) & (j > 0) & (j < view.height - 1)
    terms = [term(r_geo, planar & near, scale_geo, share, -nx, -ny, -nz, planar)]
    weights = (config.rgb_weight, config.seen_weight)
    for grey, du, dv, usable, weight in zip(*[iter(linear)] * 3, (known, inner), weights, strict=False):
        r = grey + du * (u - i) + dv * (v - j) - obs.luminance
        # dI/dq through the projection
        gx, gy = du * view.fx * inverse_z, dv * view.fy * inverse_z
        gz = -(gx * q[0] + gy * q[1]) * inverse_z
        use = usable & near & (jnp.abs(r) < config.rgb_gate)
        terms.append(term(r, use, scale_rgb, share * weight, gx, gy, gz, usable))
    return tuple(terms)


def alignment_cost(
    T: Float[Array, "4 4"], ref: ReferencePixels, obs: ObservedPixels, camera: Camera, factor: int, config: AlignConfig
) -> Float[Array, ""]:
    """Return the alignment cost: the mean of ``min(|r|, cost_limit)`` in standard deviations over all observed pixels.

    It ranks start poses. A pixel that falls on nothing known costs :attr:`AlignConfig.unseen_cost`: more than one that
    fits, so that looking away from the reference does not beat a fit, and less than one that contradicts it, so that a
    pose that contradicts the reference does not beat a turn into the unknown.
    """
    geo, rgb, *_ = linearise(T, ref, obs, camera, factor, config)
    far = jnp.where(geo.usable, jnp.minimum(jnp.abs(geo.residual), config.cost_limit), config.unseen_cost)
    off = jnp.where(rgb.usable, jnp.minimum(jnp.abs(rgb.residual), config.cost_limit), config.unseen_cost)
    return jnp.sum((far + config.rgb_weight * off) * obs.valid) / jnp.maximum(jnp.sum(obs.valid), 1)


def normal_equations(*terms: Term) -> tuple[Float[Array, "6 6"], Float[Array, "6"]]:
    """Return ``sum w J J^T`` and ``sum w J r`` by twists in the reference's frame (eq. I11)."""
    total = jnp.zeros((7, 7))
    for term in terms:
        rows = jnp.concatenate([term.jacobian, term.residual[None]])
        total = total + (rows * term.weight) @ rows.T
    return total[:6, :6], total[:6, 6]


def fit_quality(
    T: Float[Array, "4 4"],
    basis: Float[Array, "6 dof"],
    ref: ReferencePixels,
    obs: ObservedPixels,
    camera: Camera,
    config: AlignConfig,
    iterations: Array | int,
) -> AlignInfo:
    """Return the fit quality of an image and its reference at ``T`` = T_ref_cam, both at full size."""
    geo, rgb, *seen = linearise(T, ref, obs, camera, 1, config)
    share = stride(camera, 1, config) ** 2 / config.pixels_per_datum
    close_geo = geo.usable & (jnp.abs(geo.residual) < config.inlier)
    close_rgb = rgb.usable & (jnp.abs(rgb.residual) < config.inlier)
    H, _ = normal_equations(
        geo._replace(weight=share * close_geo), rgb._replace(weight=share * config.rgb_weight * close_rgb), *seen
    )
    twists = se3_adjoint(T) @ basis
    return AlignInfo(
        inlier_share=jnp.sum(close_geo) / jnp.maximum(jnp.sum(geo.usable), 1),
        coverage=jnp.sum(geo.usable) / jnp.maximum(jnp.sum(obs.valid), 1),
        photometric=jnp.sum(jnp.abs(rgb.residual) * rgb.usable) / jnp.maximum(jnp.sum(rgb.usable), 1),
        information=twists.T @ H @ twists,
        iterations=jnp.asarray(iterations),
    )
