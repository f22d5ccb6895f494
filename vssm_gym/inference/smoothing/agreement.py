"""Compare all images of a trajectory at the elements of the surfaces, the map being integrated out (ours).

An image at pose ``T_t`` observes element ``v`` at the pixel ``pi(T_t^-1 p_v)``: the distance of its plane there along
the normal, and its luminance,

    r_tv = <n, T_t^-1 p_v> - <n, p> = m_v + e,      c_tv = I_t[pi(T_t^-1 p_v)] = a_v + e',      e ~ N(0, s^2)

with ``m_v`` the element's displacement and ``a_v`` its luminance: the map, whose prior is broad. ``q(M)`` of a
linear Gaussian model is known in closed form, ``m_v = sum_t w_tv r_tv / sum_t w_tv``. With it the cost of the poses
alone, to second order in their errors ``xi_t``, is

    1/2 sum_v sum_t w_tv (r_tv + J_tv xi_t - m_v(xi))^2
    H_ts = [t = s] sum_v (w J J^T)_tv - sum_v (w J)_tv (w J)_sv^T / W_v,    W_v = sum_t w_tv

The second part couples all images that see an element: a loop is closed in one step, where taking turns between poses
and map would carry the correction from image to image. The weights are Huber's, about the mean.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import ColourCamera, displacements
from vssm_gym.geometry.transforms import inverse, transform
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.smoothing.exposure import gains
from vssm_gym.inference.smoothing.views import Elements, StackedViews

UNREAD_BORDER = 3  # pixels at an image's edge that are not read
SAME_SIDE = 0.7  # least cosine between the normals of an element and of an image there
MOST_APART = 4.0  # standard deviations of a reading, and the gate: planes farther apart are of different surfaces
CUBE, CUBES = 0.4, 509  # m, edge of the cubes in which errors of surfaces count as one; and the most of them
REWEIGHTED = 2  # times that the weights follow from the mean


class Observed(NamedTuple):
    """Hold what one image observes of the elements, with derivatives by the camera's twist."""

    distance: Float[Array, "elements"]  # m, of the element before the image's plane
    normal: Float[Array, "elements 3"]  # of that plane, world
    std: Float[Array, "elements"]  # m
    luminance: Float[Array, "elements"]
    slope: Float[Array, "elements 3"]  # of the luminance by the place, 1/m, world
    point: Float[Array, "elements 3"]  # m, the element in the camera's frame
    seen: Float[Array, "elements"]  # 1, or 0
    point_colour: Float[Array, "elements 3"]  # m, in the colour camera's frame
    coloured: Float[Array, "elements"]  # 1 where the luminance is read as well, or 0


class Border(NamedTuple):
    """Hold the quadratic cost of what all images share: the calibration of the colour camera."""

    hessian: Float[Array, "10 10"]
    gradient: Float[Array, "10"]
    by_region: Float[Array, "regions 10"]
    with_poses: Float[Array, "time 6 10"]


class NormalEquations(NamedTuple):
    """Hold the quadratic cost of the cameras' twists ``(translation, rotation)``, in their own frames."""

    hessian: Float[Array, "time 6 time 6"]
    gradient: Float[Array, "time 6"]
    by_region: Float[Array, "regions time 6"]  # the gradient's parts, by where the elements are
    cost: Float[Array, ""]  # mean of a residual's absolute value in standard deviations, at most MOST_APART
    by_image: Float[Array, "time"]  # number of elements that an image sees, and another one too
    pairs: Float[Array, ""]  # their sum: of an image and an element that it sees, with another one that sees it
    border: Border | None  # where colour has a camera of its own


@partial(jax.jit, static_argnames="config")
def normal_equations(
    views: StackedViews,
    T_world_cam: Float[Array, "time 4 4"],
    elements: Elements,
    config: AlignConfig,
    gate: float | Array,
) -> NormalEquations:
    """Return the cost of the poses with the elements' displacements and luminances integrated out, to second order.

    Args:
        views: the images.
        T_world_cam: poses to linearise about.
        elements: drawn from the images.
        config: standard deviations and weights of the alignment.
        gate: m, within which a plane may belong to an element.
    """
    colour_camera = views.colour or ColourCamera(views.camera, jnp.eye(4))
    see = lambda at: _observe(at[0], at[1], at[2], views.camera, colour_camera, elements, config, gate)
    seen = jax.lax.map(see, (views.plane, views.luminance, T_world_cam))
    shared, coloured = (which * (jnp.sum(which, axis=0) >= 2.0) for which in (seen.seen, seen.coloured))
    if views.colour is not None:  # a gain that changes with the view would pass for an error of the calibration
        gain = gains(seen.luminance, coloured)
        seen = seen._replace(luminance=gain[:, None] * seen.luminance, slope=gain[:, None, None] * seen.slope)
    colour_std = jnp.full(seen.std.shape, config.rgb_sigma / config.rgb_weight**0.5)
    slope = _mean(seen.slope, coloured)
    by_pose = lambda gradient: _by_twist(gradient, T_world_cam, seen.point)
    geometry = _integrated(seen.distance, by_pose(_mean(seen.normal, shared)), seen.std, shared, config.huber)
    colour = _integrated(seen.luminance, by_pose(slope), colour_std, coloured, config.huber)
    hessian, parts = geometry[0] + colour[0], geometry[1] + colour[1]
    region = _region(elements.point)
    by_region = jax.ops.segment_sum(parts.transpose(1, 0, 2), region, CUBES)
    pairs = jnp.sum(shared)
    cost = (geometry[2] + colour[2]) / jnp.maximum(pairs, 1.0)
    border = None
    if views.colour is not None:
        in_colour = T_world_cam[:, :3, :3] @ views.colour.T_depth_colour[:3, :3]
        along = _across_rays(_mean(seen.slope, coloured), elements.normal, in_colour, seen.point_colour)
        by_theta = jnp.einsum("tvi,tvik->tvk", along, displacements(seen.point_colour))
        border = _border(seen.luminance, by_pose(slope), by_theta, colour_std, coloured, config.huber, region)
    return NormalEquations(hessian, jnp.sum(parts, axis=1), by_region, cost, jnp.sum(shared, axis=1), pairs, border)


def _mean(gradient: Array, seen: Array) -> Float[Array, "elements 3"]:
    """Return the gradient of each element, of the images that see it.

    One for all: with its own, noisy one each image would resist a motion of all images together, which the map follows.
    """
    return jnp.einsum("tv,tvi->vi", seen, gradient) / jnp.maximum(jnp.sum(seen, axis=0), 1.0)[:, None]


def _across_rays(slope: Array, normal: Array, R_world_colour: Array, q: Array) -> Float[Array, "time elements 3"]:
    """Return the slope of the luminance as each image has it, of the one on the surface, colour camera frame.

    A displacement along a ray moves nothing in the image, and the rays of an element differ: ``g - n <g, q> / <n, q>``
    is the gradient ``g`` along the surface, extended so that it is constant along the ray of q.
    """
    g = slope - normal * jnp.sum(normal * slope, axis=-1, keepdims=True)
    g, n = jnp.einsum("vi,tij->tvj", g, R_world_colour), jnp.einsum("vi,tij->tvj", normal, R_world_colour)
    cosine = jnp.sum(n * q, axis=-1)
    cosine = jnp.where(jnp.abs(cosine) < 0.1, jnp.inf, cosine)  # m: seen too aslant, or not at all
    return g - n * (jnp.sum(g * q, axis=-1) / cosine)[..., None]


def _by_twist(gradient: Array, T_world_cam: Array, point: Array) -> Float[Array, "time elements 6"]:
    """Return derivatives by the twist (t, w) of each camera, which moves a point of its frame by ``-(t + w x q)``."""
    g = jnp.einsum("vi,tij->tvj", gradient, T_world_cam[:, :3, :3])
    return -jnp.concatenate([g, jnp.cross(point, g)], axis=-1)


def _region(point: Float[Array, "elements 3"]) -> Int[Array, "elements"]:
    """Return the number of the cube that holds a point; of a hash, so that two far ones may share it."""
    x, y, z = jnp.moveaxis(jnp.floor(point / CUBE).astype(jnp.int32), -1, 0)
    return jnp.mod(73856093 * x ^ 19349663 * y ^ 83492791 * z, CUBES)


def _observe(
    plane: Array,
    grey: Array,
    T_world_cam: Array,
    camera: Camera,
    colour: ColourCamera,
    elements: Elements,
    config: AlignConfig,
    gate: float | Array,
) -> Observed:
    """Return what an image observes of each element."""
    T = inverse(T_world_cam)
    q = transform(T, elements.point)
    facing = elements.normal @ T[:3, :3].T
    u, v, z, inside = _pixels(q, camera)
    nearest = jnp.round(v).astype(jnp.int32) * camera.width + jnp.round(u).astype(jnp.int32)
    here = plane.reshape(-1, 4)[nearest]
    n = here[:, :3]
    r = jnp.sum(n * q, axis=-1) - here[:, 3]
    std = config.geo_sigma + config.geo_sigma_quadratic * z**2
    same = jnp.sum(n * facing, axis=-1) > SAME_SIDE  # no plane has a normal of 0
    seen = inside & same & (jnp.abs(r) < jnp.maximum(gate, MOST_APART * std))
    T_depth_colour = jnp.asarray(colour.T_depth_colour, q.dtype)
    q_colour = transform(inverse(T_depth_colour), q)
    value, slope, read = _luminance(grey, q_colour, colour.camera)
    R_world_colour = T_world_cam[:3, :3] @ T_depth_colour[:3, :3]
    one = lambda which: which.astype(jnp.float32)
    normal, slope = n @ T_world_cam[:3, :3].T, slope @ R_world_colour.T
    return Observed(r, normal, std, value, slope, q, one(seen), q_colour, one(seen & read))


def _pixels(q: Array, camera: Camera) -> tuple[Array, Array, Array, Array]:
    """Return column, row, depth, and whether the pixel is read, of points of the camera's frame."""
    z = jnp.maximum(q[:, 2], 0.1)
    u, v = camera.fx * q[:, 0] / z + camera.cx, camera.fy * q[:, 1] / z + camera.cy
    high, wide = camera.height - 1 - UNREAD_BORDER, camera.width - 1 - UNREAD_BORDER
    inside = (q[:, 2] > 0.1) & (u >= UNREAD_BORDER) & (u <= wide) & (v >= UNREAD_BORDER) & (v <= high)
    return jnp.clip(u, UNREAD_BORDER, wide), jnp.clip(v, UNREAD_BORDER, high), z, inside


def _luminance(grey: Array, q: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Return luminance, its slope by the place (1/m, camera frame), and whether it is read, at points of the frame."""
    u, v, z, inside = _pixels(q, camera)
    i, j = jnp.floor(u).astype(jnp.int32), jnp.floor(v).astype(jnp.int32)
    a, b = u - i, v - j
    flat = grey.reshape(-1)
    at = lambda di, dj: flat[(j + dj) * camera.width + i + di]
    mixed = lambda di, dj: (
        (1.0 - b) * ((1.0 - a) * at(di, dj) + a * at(di + 1, dj))
        + b * ((1.0 - a) * at(di, dj + 1) + a * at(di + 1, dj + 1))
    )
    along_u = 0.5 * (mixed(1, 0) - mixed(-1, 0)) * camera.fx / z
    along_v = 0.5 * (mixed(0, 1) - mixed(0, -1)) * camera.fy / z
    slope = jnp.stack([along_u, along_v, -(along_u * q[:, 0] + along_v * q[:, 1]) / z], axis=-1)
    return mixed(0, 0), slope, inside


def _about_means(value: Array, std: Array, seen: Array, huber: float) -> tuple[Array, Array, Array, Array]:
    """Return Huber's weights, their sum for each element, residuals about the mean, and their sizes in deviations."""
    weight = seen / std**2
    for _ in range(REWEIGHTED + 1):
        total = jnp.maximum(jnp.sum(weight, axis=0), 1e-12)
        off = value - jnp.sum(weight * value, axis=0) / total
        scaled = jnp.abs(off) / std
        weight = seen / std**2 * jnp.minimum(1.0, huber / jnp.maximum(scaled, 1e-9))
    total = jnp.maximum(jnp.sum(weight, axis=0), 1e-12)
    return weight, total, value - jnp.sum(weight * value, axis=0) / total, scaled


def _integrated(value: Array, by_pose: Array, std: Array, seen: Array, huber: float) -> tuple[Array, Array, Array]:
    """Return the Hessian, the gradient of each element ``(time, elements, 6)`` and the cost, about the means."""
    weight, total, off, scaled = _about_means(value, std, seen, huber)
    weighted = weight[..., None] * by_pose
    own = jnp.einsum("tvi,tvj->tij", weighted, by_pose)
    rows = (weighted / jnp.sqrt(total)[:, None]).transpose(1, 0, 2).reshape(value.shape[1], -1)
    times = len(value)
    coupled = (rows.T @ rows).reshape(times, 6, times, 6)
    index = jnp.arange(times)
    hessian = (-coupled).at[index, :, index].add(own)
    return hessian, weighted * off[..., None], jnp.sum(seen * jnp.minimum(scaled, MOST_APART))


def _border(
    value: Array, by_pose: Array, by_theta: Array, std: Array, seen: Array, huber: float, region: Array
) -> Border:
    """Return the cost of what all images share, about the means."""
    weight, total, off, _ = _about_means(value, std, seen, huber)
    mean = jnp.einsum("tv,tvk->vk", weight, by_theta) / total[:, None]
    weighted = weight[..., None] * (by_theta - mean)
    parts = jnp.einsum("tvk,tv->vk", weighted, off)
    return Border(
        jnp.einsum("tvk,tvl->kl", weighted, by_theta),
        jnp.sum(parts, axis=0),
        jax.ops.segment_sum(parts, region, CUBES),
        jnp.einsum("tvi,tvk->tik", by_pose, weighted),
    )
