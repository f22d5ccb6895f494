"""Localisation through the renderer: ``argmax_z log p(x_t | z, M) + log p(z | z_t-1, u_t-1)`` by Adam (SPEC 4; TNP-SM).

The *emission-based* tracker, a comparison. Where :mod:`vssm_gym.inference.tracking` aligns an image to one rendered
reference, this one renders the drawn pixels anew at every step and follows the gradient of ``log p`` in the pose, which
comes from the interpolation at the hit alone: a search along 200 rays a step, and no association but the ray's own.
"""

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym import emission
from vssm_gym.emission import RGBD, EmissionScales
from vssm_gym.geometry import se3_exp
from vssm_gym.inference.adam import AdamConfig, minimise
from vssm_gym.inference.alignment import agreement, make_observed, make_reference, stride
from vssm_gym.inference.tracking import (
    RobotRig,
    TrackerConfig,
    TrackerInfo,
    TrackerState,
    conclude,
    planar_basis,
    predict,
    prior_precision,
)
from vssm_gym.transition import MotionNoise, PlanarBelief
from vssm_gym.voxel_map import VoxelMap

TRACKER_ADAM = AdamConfig(steps=100, translation_step=0.003, rotation_step=0.003)


@dataclass(frozen=True)
class EmissionTrackerConfig:
    """Search, emission, and the test for loss of track, which is that of the other trackers."""

    adam: AdamConfig = TRACKER_ADAM  # its gates leave out pixels that see another surface
    scales: tuple[float, float] = (0.02, 0.1)  # of the emission: depth (m) and a colour channel; those of the aligners
    max_depth: float = emission.MAX_DEPTH
    tracker: TrackerConfig = field(default_factory=TrackerConfig)


@partial(jax.jit, static_argnums=5)
def _descend(
    predicted: PlanarBelief,
    T_world_pred: Float[Array, "4 4"],
    image: RGBD,
    m: VoxelMap,
    rig: RobotRig,
    config: EmissionTrackerConfig,
) -> Float[Array, "4 4"]:
    """T_world_cam at the MAP: ``T_world_pred exp(B xi)``, the pixels drawn anew and rendered at every step."""
    camera, basis = rig.camera, planar_basis(rig)
    precision = prior_precision(predicted, config.tracker)
    width = camera.width
    depth, rgb = image.depth.reshape(-1), image.rgb.reshape(-1, 3)
    (usable,) = jnp.nonzero(image.hit.reshape(-1), size=depth.shape[0], fill_value=0)
    count = jnp.sum(image.hit)
    # The same pixels at every call: a step stays a function of its arguments.
    draws = jax.random.randint(jax.random.key(0), (config.adam.steps, config.adam.pixels), 0, jnp.maximum(count, 1))
    scales = EmissionScales(*config.scales)

    def rays(T, pixel):
        x, y = (pixel % width - camera.cx) / camera.fx, (pixel // width - camera.cy) / camera.fy
        return T[:3, 3], jnp.stack([T[a, 0] * x + T[a, 1] * y + T[a, 2] for a in range(3)], axis=-1)

    def loss(xi, i):
        pixel = usable.at[draws[i]].get(mode="promise_in_bounds")
        T = T_world_pred @ se3_exp(basis @ xi)
        centre, directions = rays(T, pixel)
        k, hit = emission.search(*jax.lax.stop_gradient((m, centre, directions)), config.max_depth)
        d = emission.intersect(m, centre, directions, jnp.where(hit, k, 2))
        colour = m.field(centre + directions * d[:, None])[..., 1:]
        off, off_colour = jnp.abs(d - depth[pixel]), jnp.abs(colour - rgb[pixel])
        near = hit & (off < config.adam.geo_gate) & (count > 0)
        alike = near & (off_colour.mean(-1) < config.adam.rgb_gate)
        data = jnp.sum(near * off) / scales.depth + jnp.sum(alike * off_colour.sum(-1)) / scales.rgb
        return data + 0.5 * xi @ precision @ xi

    xi = minimise(loss, jnp.zeros(basis.shape[1]), basis, config.adam)
    return T_world_pred @ se3_exp(basis @ xi)


@partial(jax.jit, static_argnums=6)
def _judge(
    state: TrackerState,
    predicted: PlanarBelief,
    rendered: RGBD,
    T_world_cam: Float[Array, "4 4"],
    image: RGBD,
    rig: RobotRig,
    config: TrackerConfig,
) -> tuple[TrackerState, TrackerInfo]:
    """How well the image agrees with the one rendered at the estimate, and the belief that follows."""
    reference = make_reference(rendered, rig.camera, config.align)
    observed = make_observed(image, rig.camera, every=stride(rig.camera, 1, config.align))
    fit = agreement(jnp.eye(4), planar_basis(rig), reference, observed, rig.camera, config.align, 0)
    return conclude(state, predicted, T_world_cam, fit, image, rig, config)


def step_emission(
    state: TrackerState,
    control: Float[Array, "3"],
    image: RGBD,
    m: VoxelMap,
    rig: RobotRig,
    noise: MotionNoise,
    config: EmissionTrackerConfig = EmissionTrackerConfig(),
) -> tuple[TrackerState, TrackerInfo]:
    """``argmax_z log p(x_t | z, M) + log p(z | z_t-1, u_t-1)`` through the renderer; see the module.

    Args:
        state: The belief after the last step.
        control: (turn, offset, step) commanded since.
        image: The camera image now.
        m: The map, fixed.
        rig: Camera and its place on the robot.
        noise: Execution noise of the motion model.
        config: Search, emission, loss test.

    Returns:
        The next state and how the step went, as :func:`vssm_gym.inference.tracking.step_map`.
    """
    predicted, T_world_pred = predict(state.belief, control, noise, rig)
    T_world_cam = _descend(predicted, T_world_pred, image, m, rig, config)
    rendered = emission.render(m, T_world_cam, rig.camera)
    return _judge(state, predicted, rendered, T_world_cam, image, rig, config.tracker)
