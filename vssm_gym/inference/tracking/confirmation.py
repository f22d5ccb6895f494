"""Confirm an aligned pose by colour: what a false depth image, or a false colour image, does to a pose (ours)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.agreement import agreement
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import AlignConfig, make_observed, make_reference, stride
from vssm_gym.model.emission import RGBD


@dataclass(frozen=True)
class ConfirmationConfig:
    """Configure which poses the colour must confirm, and how well it must fit."""

    colour_margin: float = 0.1  # stds of the luminance: so much worse than at a start the colour may fit there
    min_correlation: float = 0.7  # of the luminances of image and reference, where
    min_contrast: float = 1.5  # the image's luminance varies by at least so many stds
    confirming_correlation: float = 0.85  # of the luminances after a step that must be confirmed


def colour_confirms(
    T: Float[Array, "4 4"],
    starts: Float[Array, "starts 4 4"],
    expected: Bool[Array, ""],
    reference: ReferenceView,
    image: RGBD,
    camera: Camera,
    align: AlignConfig,
    config: ConfirmationConfig,
) -> Bool[Array, ""]:
    """Return true where the colours of an image and its reference view confirm a pose (eq. I28).

    Args:
        T: T_ref_cam, the result of the alignment.
        starts: T_ref_cam of the poses that the alignment could start from.
        expected: the prediction foresees the step: it needs no confirmation, and must only be plausible.
        reference: the reference view.
        image: the image, at the reference's exposure.
        camera: intrinsics of both.
        align: scales of the alignment.
        config: thresholds.
    """
    ref = make_reference(reference.image, camera, align, 1, reference.seen, reference.spread)
    obs = make_observed(image, camera, 1, stride(camera, 1, align))
    poses = jnp.concatenate([T[None], starts])
    every = jax.vmap(lambda pose: agreement(pose, ref, obs, camera, 1, align))(poses)
    found, best = jax.tree.map(lambda values: values[0], every), jnp.min(every.cost[1:])
    plausible = (found.correlation >= config.min_correlation) | (found.contrast < config.min_contrast)
    confirmed = (found.correlation >= config.confirming_correlation) & (found.cost <= best + config.colour_margin)
    return plausible & (expected | confirmed)
