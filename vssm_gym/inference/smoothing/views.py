"""Hold the images of a trajectory as planes and luminances, and draw elements of the surface from them.

An element is a small piece of a surface: a point with a normal. Elements are pixels drawn at random from all images
(reconstruction sampling, VSSM-LM, section 4), carried into the world by the pose of their image.
"""

from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import ColourCamera
from vssm_gym.inference.alignment.residuals import luminance
from vssm_gym.model.emission import RGBD

NORMAL_REACH = 2  # pixels on either side, from which a normal is computed
MOST_BEND = 3.0  # standard deviations of depth by which the neighbours' mean may differ from the middle
LEAST_COSINE = 0.25  # between ray and normal: what is seen at a smaller angle has no depth to rely on


class StackedViews(eqx.Module):
    """Hold the images of one camera, one after the other.

    Attributes:
        plane: unit normal and offset ``<n, p>`` (m) of the surface at each pixel, camera frame; 0 where there is none.
        luminance: in [0, 1].
        pixels: numbers of those that have a plane, counted over all images.
        camera: intrinsics and size of the depth images.
        colour: the camera of the luminances, where it is another one; None: they are registered to depth.
    """

    plane: Float[Array, "time height width 4"]
    luminance: Float[Array, "time rows columns"]
    pixels: Int[Array, "pixels"]
    camera: Camera
    colour: ColourCamera | None = None


class Elements(eqx.Module):
    """Hold points of surfaces with their normals, world frame, m."""

    point: Float[Array, "elements 3"]
    normal: Float[Array, "elements 3"]


def stack_views(images: list[RGBD], camera: Camera, depth_std: tuple[float, float]) -> StackedViews:
    """Compute planes and luminances of images.

    Args:
        images: of the camera; an image without a reading has no plane.
        camera: their intrinsics.
        depth_std: standard deviation of a reading, at the camera (m) and its growth with the depth squared (1/m).
    """
    return _stacked([image.depth for image in images], [image.rgb for image in images], camera, depth_std)


def stack_apart(
    images: list[tuple[np.ndarray, np.ndarray]], camera: Camera, colour: ColourCamera, depth_std: tuple[float, float]
) -> StackedViews:
    """Compute planes and luminances of the images of two cameras.

    Args:
        images: colour uint8 ``(rows, columns, 3)`` and z-depth ``(height, width)`` in m.
        camera: of depth.
        colour: the other one, and its pose.
        depth_std: as in :func:`stack_views`.
    """
    colours = [jnp.asarray(rgb, jnp.float32) / 255.0 for rgb, _ in images]
    views = _stacked([jnp.asarray(depth) for _, depth in images], colours, camera, depth_std)
    return replace(views, colour=colour)


def _stacked(depths: list[Array], colours: list[Array], camera: Camera, depth_std: tuple[float, float]) -> StackedViews:
    plane = jnp.stack([planes(depth, camera, *depth_std) for depth in depths])
    pixels = np.flatnonzero(np.asarray(plane[..., :3].any(axis=-1)))
    return StackedViews(plane, jnp.stack([luminance(rgb) for rgb in colours]), jnp.asarray(pixels), camera)


@partial(jax.jit, static_argnames="count")
def draw_elements(
    key: PRNGKeyArray, views: StackedViews, T_world_cam: Float[Array, "time 4 4"], count: int
) -> Elements:
    """Draw pixels that have a plane, all equally likely, and carry their planes into the world.

    Args:
        key: random key.
        views: the images.
        T_world_cam: poses of the camera at them.
        count: number of elements.
    """
    _, height, width, _ = views.plane.shape
    drawn = views.pixels[jax.random.randint(key, (count,), 0, len(views.pixels))]
    return elements_at(views, T_world_cam, drawn // (height * width), drawn % (height * width))


@jax.jit
def elements_at(
    views: StackedViews,
    T_world_cam: Float[Array, "time 4 4"],
    image: Int[Array, "elements"],
    pixel: Int[Array, "elements"],
) -> Elements:
    """Carry the planes at pixels of images into the world.

    Args:
        views: the images.
        T_world_cam: poses of the camera at them.
        image: numbers of images.
        pixel: numbers of pixels in them, which have a plane.
    """
    plane = views.plane.reshape(len(views.plane), -1, 4)[image, pixel]
    ray = views.camera.rays().reshape(-1, 3)[pixel]
    normal = plane[:, :3]
    depth = plane[:, 3] / jnp.sum(normal * ray, axis=-1)
    turned = lambda v: jnp.einsum("eij,ej->ei", T_world_cam[image, :3, :3], v)
    return Elements(turned(ray * depth[:, None]) + T_world_cam[image, :3, 3], turned(normal))


@jax.jit
def planes(depth: Array, camera: Camera, std: float | Array, growth: float | Array) -> Float[Array, "height width 4"]:
    """Return the plane through the neighbours of each pixel; 0 at edges, holes and grazing views.

    Args:
        depth: of an image, m; 0 or not finite where there is none.
        camera: of the image.
        std: of a reading at the camera, m.
        growth: of that standard deviation with the depth squared, 1/m.
    """
    depth = jnp.where(jnp.isfinite(depth) & (depth > 0.0), depth, 0.0)
    p = camera.rays() * depth[..., None]
    beside = lambda a, by, axis: (jnp.roll(a, -by, axis), jnp.roll(a, by, axis))
    (right, left), (down, up) = beside(p, NORMAL_REACH, 1), beside(p, NORMAL_REACH, 0)
    normal = jnp.cross(down - up, right - left)
    length = jnp.linalg.norm(normal, axis=-1, keepdims=True)
    normal = normal / jnp.maximum(length, 1e-12)
    bend = MOST_BEND * (std + growth * depth**2)
    smooth = (depth > 0.0) & (length[..., 0] > 1e-12)
    for by in range(1, NORMAL_REACH + 1):
        for axis in (0, 1):
            a, b = beside(depth, by, axis)
            smooth &= (a > 0.0) & (b > 0.0) & (jnp.abs(a + b - 2.0 * depth) < 2.0 * bend + 0.01 * depth)
    smooth = smooth & jnp.zeros_like(smooth).at[
        NORMAL_REACH + 1 : -NORMAL_REACH - 1, NORMAL_REACH + 1 : -NORMAL_REACH - 1
    ].set(True)
    ray = camera.rays()
    cosine = jnp.abs(jnp.sum(normal * ray, axis=-1)) / jnp.linalg.norm(ray, axis=-1)
    plane = jnp.concatenate([normal, jnp.sum(normal * p, axis=-1, keepdims=True)], axis=-1)
    return jnp.where((smooth & (cosine > LEAST_COSINE))[..., None], plane, 0.0)
