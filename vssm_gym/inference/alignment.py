"""Pose by MAP: ``argmin_T L_geo + L_rgb - log q(T)``, robust Gauss-Newton over all pixels (SPEC 3, step 2; PRISM).

An observed RGB-D image is aligned to a reference image, rendered from the map or taken earlier. With ``T = T_ref_cam``
and projective association, ``r_geo = <p^ - T p, n^>`` and ``r_rgb = I^[pi(T p)] - I[pi(p)]`` on luminance. Each is
scaled by its standard deviation and made robust by Huber's function, which is the published L1 norm beyond the elbow
and quadratic below it, where Gauss-Newton needs a curvature. The motion lives in a subspace ``T = T_prior exp(B xi)``:
``B`` is the identity for a free camera and the three planar twists for a robot on a floor, which then stays on it
exactly.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.camera import Camera
from vssm_gym.emission import RGBD
from vssm_gym.geometry import inverse, se3_exp, se3_log


@dataclass(frozen=True)
class AlignConfig:
    """Scales, gates and effort of the alignment."""

    geo_sigma: float = 0.004  # m, of the point-to-plane residual at depth 0
    geo_sigma_quadratic: float = 0.0025  # 1/m: grows with depth squared, as a structured-light or stereo sensor's
    rgb_sigma: float = 0.04  # luminance in [0, 1]
    huber: float = 1.345  # elbow, in standard deviations
    geo_gate: float = 0.30  # m; pairs farther apart are different surfaces
    rgb_gate: float = 0.30  # luminance
    rgb_weight: float = 0.6  # of photometry against geometry
    pixels_per_datum: float = 30.0  # neighbouring pixels err together: so many count as one independent residual
    levels: tuple[int, ...] = (4, 2, 1)  # image shrink factors, coarse to fine
    iterations: tuple[int, ...] = (6, 5, 5)  # at most, per level
    tolerance: float = 1e-5  # m and rad: a smaller step ends the level
    edge: float = 0.05  # relative depth jump to a neighbour that makes a reference pixel unusable


class Reference(eqx.Module):
    """What is aligned to: per pixel a plane and a linear piece of the image; zeros where there is none."""

    plane: Float[Array, "4 pixels"]  # unit normal and its offset <n, p>, camera frame; all 0 where unknown
    image: Float[Array, "3 pixels"]  # luminance and its two derivatives per pixel
    textured: Bool[Array, "pixels"]  # where the image means anything


class Observed(eqx.Module):
    """What is aligned: points and luminance of an image."""

    points: Float[Array, "3 pixels"]  # camera frame, m
    luminance: Float[Array, "pixels"]
    valid: Bool[Array, "pixels"]


class AlignInfo(eqx.Module):
    """How well the images agree at the solution."""

    inlier_share: Float[Array, ""]  # of the projected pixels with a plane: |r_geo| < 2.5 sigma
    coverage: Float[Array, ""]  # share of observed pixels that fall on a reference plane
    photometric: Float[Array, ""]  # mean |r_rgb| / sigma
    information: Float[Array, "dof dof"]  # of the data about xi: sum J^T J of the scaled residuals, per datum
    iterations: Array  # on the finest level


def luminance(rgb: Float[Array, "height width 3"]) -> Float[Array, "height width"]:
    """Mean of the channels, [0, 1]."""
    return jnp.mean(rgb, axis=-1)


def shrink_depth(depth: Array, factor: int) -> Array:
    """Every ``factor``-th pixel block's reading nearest to the camera's axis of the block (its upper-left centre)."""
    if factor == 1:
        return depth
    h, w = depth.shape[0] // factor, depth.shape[1] // factor
    o = factor // 2
    return depth[o : o + h * factor : factor, o : o + w * factor : factor]


def shrink_image(image: Array, factor: int) -> Array:
    """Mean over ``factor x factor`` pixels."""
    if factor == 1:
        return image
    h, w = image.shape[0] // factor, image.shape[1] // factor
    return image[: h * factor, : w * factor].reshape(h, factor, w, factor).mean(axis=(1, 3))


def shrink_camera(camera: Camera, factor: int) -> Camera:
    """The camera whose pixels are the kept depth readings.

    A block's mean luminance belongs to the block's centre, up to a quarter of a shrunk pixel beside its kept reading;
    but it does so in both images alike, and an image aligned to itself stays where it is.
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


def make_reference(image: RGBD, camera: Camera, config: AlignConfig, factor: int = 1) -> Reference:
    """Planes and image derivatives of an RGB-D image, shrunk by ``factor``."""
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
    (right, left), (down, up) = sides(grey, 1), sides(grey, 0)
    known = shrink_image(image.known.astype(jnp.float32), factor) > 0.999
    textured = known & inner
    for neighbour in (*sides(known, 0), *sides(known, 1)):
        textured &= neighbour
    linear = jnp.stack([grey, 0.5 * (right - left), 0.5 * (down - up)])
    return Reference(jnp.moveaxis(plane, -1, 0).reshape(4, -1), linear.reshape(3, -1), textured.reshape(-1))


def make_observed(image: RGBD, camera: Camera, factor: int = 1) -> Observed:
    """Points and luminance of an observed image, shrunk by ``factor``."""
    depth = shrink_depth(jnp.where(image.hit, image.depth, 0.0), factor)
    p = shrink_camera(camera, factor).backproject(depth)
    grey = shrink_image(luminance(image.rgb), factor)
    return Observed(jnp.moveaxis(p, -1, 0).reshape(3, -1), grey.reshape(-1), (depth > 0.0).reshape(-1))


def _linearise(
    T: Array, basis: Array, ref: Reference, obs: Observed, camera: Camera, factor: int, config: AlignConfig
) -> tuple[Array, Array, Array, tuple[Array, Array, Array, Array, float]]:
    """Residuals, weights and Jacobians (dof, pixels) in the basis at ``T`` = T_ref_cam, both kinds stacked."""
    view = shrink_camera(camera, factor)
    R, t = T[:3, :3], T[:3, 3]
    p = obs.points
    q = R @ p + t[:, None]
    ahead = obs.valid & (q[2] > 0.05)
    inverse_z = 1.0 / jnp.where(ahead, q[2], 1.0)
    u, v = q[0] * inverse_z * view.fx + view.cx, q[1] * inverse_z * view.fy + view.cy
    i, j = jnp.round(u).astype(jnp.int32), jnp.round(v).astype(jnp.int32)
    inside = ahead & (i >= 0) & (i < view.width) & (j >= 0) & (j < view.height)
    pixel = jnp.where(inside, j * view.width + i, 0)

    def look(a):
        return a.at[pixel].get(mode="promise_in_bounds")

    n = [look(ref.plane[c]) for c in range(3)]
    planar = inside & (n[0] * n[0] + n[1] * n[1] + n[2] * n[2] > 0.5)
    r_geo = look(ref.plane[3]) - (n[0] * q[0] + n[1] * q[1] + n[2] * q[2])
    grey, du, dv = (look(ref.image[c]) for c in range(3))
    r_rgb = grey + du * (u - i) + dv * (v - j) - obs.luminance
    textured = inside & look(ref.textured)
    # dI/dq through the projection, in the reference frame
    gx, gy = du * view.fx * inverse_z, dv * view.fy * inverse_z
    g = [gx, gy, -(gx * q[0] + gy * q[1]) * inverse_z]

    def jacobian(m, sign):
        """Of a residual with gradient ``sign m`` by the point: T exp(d) moves it by R (d_t + d_r x p)."""
        a = R.T @ jnp.stack(m)
        moment = jnp.stack([p[1] * a[2] - p[2] * a[1], p[2] * a[0] - p[0] * a[2], p[0] * a[1] - p[1] * a[0]])
        return sign * (basis.T @ jnp.concatenate([a, moment]))

    sigma_geo = config.geo_sigma + config.geo_sigma_quadratic * p[2] * p[2]
    scaled_geo, scaled_rgb = r_geo / sigma_geo, r_rgb / config.rgb_sigma
    use_geo = planar & (jnp.abs(r_geo) < config.geo_gate)
    use_rgb = textured & (jnp.abs(r_rgb) < config.rgb_gate) & (jnp.abs(r_geo) < config.geo_gate)

    def huber(s):
        return jnp.minimum(1.0, config.huber / jnp.maximum(jnp.abs(s), 1e-9))

    residual = jnp.concatenate([scaled_geo, scaled_rgb])
    share = 1.0 / config.pixels_per_datum * factor * factor
    weight = share * jnp.concatenate([use_geo * huber(scaled_geo), config.rgb_weight * use_rgb * huber(scaled_rgb)])
    J = jnp.concatenate([jacobian(n, -1.0) / sigma_geo, jacobian(g, 1.0) / config.rgb_sigma], axis=1)
    return residual, weight, J, (planar, scaled_geo, textured, scaled_rgb, share)


def align(
    T_prior: Float[Array, "4 4"],
    prior_precision: Float[Array, "dof dof"],
    T_start: Float[Array, "4 4"],
    basis: Float[Array, "6 dof"],
    reference: RGBD,
    observed: RGBD,
    camera: Camera,
    config: AlignConfig,
) -> tuple[Float[Array, "4 4"], AlignInfo]:
    """``argmin_xi  sum rho(r_geo) + rho(r_rgb) + 1/2 xi^T P xi``, ``T_ref_cam = T_prior exp(B xi)``.

    Args:
        T_prior: Mean of the prior on T_ref_cam.
        prior_precision: P, in the basis' coordinates.
        T_start: Where the search begins; differs from ``T_prior`` by a motion inside the basis.
        basis: B, the twists (translation, rotation; camera frame) the camera may move along.
        reference: RGB-D image at the reference pose.
        observed: RGB-D image at the unknown pose.
        camera: Intrinsics of both.
        config: Scales, gates, effort.

    Returns:
        T_ref_cam at the optimum and how well the images agree there.
    """
    coordinates = jnp.linalg.pinv(basis)
    T_inverse_prior = inverse(T_prior)

    def solve_level(T, factor, iterations):
        ref = make_reference(reference, camera, config, factor)
        obs = make_observed(observed, camera, factor)

        def step(carry):
            T, _, count = carry
            residual, weight, J, _ = _linearise(T, basis, ref, obs, camera, factor, config)
            xi = coordinates @ se3_log(T_inverse_prior @ T)
            wJ = J * weight
            H = wJ @ J.T + prior_precision
            gradient = wJ @ residual + prior_precision @ xi
            # A little damping keeps an unobserved direction (zero rows) finite; it is far below any real information.
            delta = -jnp.linalg.solve(H + 1e-6 * jnp.eye(H.shape[0]) * (1.0 + jnp.trace(H)), gradient)
            return T @ se3_exp(basis @ delta), jnp.max(jnp.abs(delta)), count + 1

        def unfinished(carry):
            return (carry[2] < iterations) & (carry[1] > config.tolerance)

        T, _, count = jax.lax.while_loop(unfinished, step, (T, jnp.inf, 0))
        return T, count, ref, obs

    T = T_start
    for factor, iterations in zip(config.levels, config.iterations, strict=True):
        T, count, ref, obs = solve_level(T, factor, iterations)
    _, _, J, (planar, geo, textured, rgb, share) = _linearise(T, basis, ref, obs, camera, factor, config)
    inlier = planar & (jnp.abs(geo) < 2.5)
    used = jnp.concatenate([inlier, config.rgb_weight * (textured & (jnp.abs(rgb) < 2.5))])
    projected = jnp.maximum(jnp.sum(planar), 1)
    info = AlignInfo(
        inlier_share=jnp.sum(inlier) / projected,
        coverage=jnp.sum(planar) / jnp.maximum(jnp.sum(obs.valid), 1),
        photometric=jnp.sum(jnp.abs(rgb) * textured) / jnp.maximum(jnp.sum(textured), 1),
        information=(J * used * share) @ J.T,
        iterations=jnp.asarray(count),
    )
    return T, info
