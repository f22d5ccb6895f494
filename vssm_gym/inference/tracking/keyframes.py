"""Keep keyframes: poses with their images, from which a camera that lost track is relocalised.

A keyframe keeps its pose and a small luminance image. A lost image is compared with all of them by the correlation of
thumbnails; the best few, each turned by the rotation between the two images, are start poses for an alignment to the
map.
"""

from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.residuals import shrink_camera, shrink_image
from vssm_gym.inference.alignment.rotation import RotationConfig, camera_rotation


@dataclass(frozen=True)
class KeyframeConfig:
    """Configure the ring of keyframes: which images it keeps, and at which sizes."""

    capacity: int = 256  # the oldest are dropped first; enough for a furnished flat at these distances
    distance: float = 0.30  # m and
    angle: float = 0.26  # rad: a new keyframe is farther than one of these from every other
    width: int = 80  # pixels, of a keyframe's image
    thumbnail: int = 20  # pixels, width of its thumbnail


class Keyframes(eqx.Module):
    """Hold a ring buffer of keyframes."""

    T_world_cam: Float[Array, "n 4 4"]
    images: Float[Array, "n height width"]  # luminance, [0, 1]
    thumbnails: Float[Array, "n pixels"]  # zero mean, unit norm; all zero where no keyframe is
    count: Int[Array, ""]  # keyframes ever kept


def _factor(camera: Camera, config: KeyframeConfig) -> int:
    return max(1, camera.width // config.width)


def _thumbnail(image: Array, config: KeyframeConfig) -> Array:
    small = shrink_image(image, max(1, image.shape[1] // config.thumbnail)).reshape(-1)
    centred = small - jnp.mean(small)
    return centred / jnp.maximum(jnp.linalg.norm(centred), 1e-3)


def empty(camera: Camera, config: KeyframeConfig = KeyframeConfig()) -> Keyframes:
    """Return an empty ring for images of ``camera``."""
    view = shrink_camera(camera, _factor(camera, config))
    images = jnp.zeros((config.capacity, view.height, view.width))
    return Keyframes(
        T_world_cam=jnp.broadcast_to(jnp.eye(4), (config.capacity, 4, 4)),
        images=images,
        thumbnails=jnp.zeros((config.capacity, _thumbnail(images[0], config).size)),
        count=jnp.int32(0),
    )


@partial(jax.jit, static_argnums=4, donate_argnums=0)
def remember(
    keyframes: Keyframes,
    T_world_cam: Float[Array, "4 4"],
    grey: Float[Array, "height width"],
    camera: Camera,
    config: KeyframeConfig = KeyframeConfig(),
) -> Keyframes:
    """Keep the image if no keyframe is near its pose (eq. I31). The keyframes passed in are consumed."""
    apart = jnp.linalg.norm(keyframes.T_world_cam[:, :3, 3] - T_world_cam[:3, 3], axis=-1)
    # trace(R_a^T R_b) = 1 + 2 cos(angle)
    trace = jnp.einsum("nij,ij->n", keyframes.T_world_cam[:, :3, :3], T_world_cam[:3, :3])
    near = (apart < config.distance) & (trace > 1.0 + 2.0 * jnp.cos(config.angle))
    capacity = apart.shape[0]
    new = ~jnp.any(near & (jnp.arange(capacity) < keyframes.count))
    slot = jnp.where(new, keyframes.count % capacity, capacity)  # one past the end writes nothing
    image = shrink_image(grey, _factor(camera, config))
    return Keyframes(
        T_world_cam=keyframes.T_world_cam.at[slot].set(T_world_cam, mode="drop"),
        images=keyframes.images.at[slot].set(image, mode="drop"),
        thumbnails=keyframes.thumbnails.at[slot].set(_thumbnail(image, config), mode="drop"),
        count=keyframes.count + new,
    )


@partial(jax.jit, static_argnums=(3, 4, 5))
def similar(
    keyframes: Keyframes,
    grey: Float[Array, "height width"],
    camera: Camera,
    rotation: RotationConfig,
    best: int,
    config: KeyframeConfig = KeyframeConfig(),
) -> Float[Array, "best 4 4"]:
    """Return start poses for an image: those of the most correlated keyframes, turned by the rotation between images.

    Returns:
        T_world_cam guesses, best first; identities where there are fewer keyframes.
    """
    image = shrink_image(grey, _factor(camera, config))
    kept = jnp.arange(keyframes.thumbnails.shape[0]) < keyframes.count
    correlation = jnp.where(kept, keyframes.thumbnails @ _thumbnail(image, config), -2.0)  # any keyframe before none
    order = jnp.argsort(-correlation)[:best]
    view = shrink_camera(camera, _factor(camera, config))

    def guess(index):
        R = camera_rotation(image, keyframes.images[index], view, rotation)
        turned = keyframes.T_world_cam[index, :3, :3] @ R
        return keyframes.T_world_cam[index].at[:3, :3].set(turned)

    return jax.lax.map(guess, order)
