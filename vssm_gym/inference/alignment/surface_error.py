"""``g = sum_c G_c u_c + noise``: how errors of the surfaces that a pose is aligned to move its estimate (ours).

Residuals of neighbouring pixels are not independent: they lie on one surface, which the reference shows displaced, or
with colours that the map blurs. Pixels are therefore grouped into *patches*, the surface of one direction inside a cube
of the world. All pixels of a patch share one displacement, of unknown size, and one error of colour. What a unit error
of a patch adds to the gradient of the alignment's cost is its influence. The estimator itself is left as it is: this
is the sandwich covariance of an M-estimator with clusters (Liang and Zeger, "Longitudinal data analysis using
generalized linear models", 1986), where the size of a displacement is that of a prior and of the patch's mean residual.
"""

from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_adjoint
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    linearise,
    make_observed,
    make_reference,
    stride,
)
from vssm_gym.model.emission import RGBD

SLOTS = 256  # of the table of patches; patches of one slot count as one
PIECES = 1024  # slots of the table of pieces
_PRIMES = (73856093, 19349663, 83492791, 39916801)  # of the spatial hash (Teschner et al., 2003)


@dataclass(frozen=True)
class SurfaceErrorConfig:
    """Configure the errors of reference surfaces; chosen on the scenes for training."""

    patch: float = 1.0  # m, edge of the cubes, and the distance over which an error is forgotten as the view changes
    piece: float = 0.3  # m, edge of smaller cubes, each with an error of its own, new in every image
    pixels: int = 1250  # about so many are looked at: patches are large
    least_residual: float = 0.25  # share of a displacement that is left in the residuals, at least


class Influence(eqx.Module):
    """Hold how errors move the gradient of the alignment's cost, in the coordinates of the pose's tangent."""

    curvature: Float[Array, "p p"]  # H = J^T W J, of the data alone
    noise: Float[Array, "p p"]  # covariance by errors that are independent between pixels
    surfaces: Float[Array, "errors p"]  # G: by unit errors, displacements of all slots before colours of all slots

    @property
    def covariance(self) -> Float[Array, "p p"]:
        """``S = G^T G + N``: of the gradient, when no error is known."""
        return self.surfaces.T @ self.surfaces + self.noise

    def correlation(self, K: Float[Array, "p p"]) -> Float[Array, ""]:
        """``tr(K S) / tr(K H)`` with the gain ``K``: how many data are alike, on average over what the data fix."""
        return jnp.sum(K * self.covariance) / jnp.maximum(jnp.sum(K * self.curvature), 1e-9)


@partial(jax.jit, static_argnums=(5, 6))
def influence(
    T: Float[Array, "4 4"],
    basis: Float[Array, "6 p"],
    reference: ReferenceView,
    image: RGBD,
    camera: Camera,
    config: AlignConfig,
    surface: SurfaceErrorConfig,
) -> Influence:
    """Return what moves an estimate, at the estimate (eq. I16).

    Args:
        T: T_ref_cam, an aligned pose.
        basis: The twists (camera frame) along which the camera may move.
        reference: The view that it is aligned to.
        image: The image, at the reference's exposure.
        camera: Of both.
        config: Scales of the alignment.
        surface: Sizes of patches and of their errors.
    """
    used, config = stride(camera, 1, config), replace(config, pixels=surface.pixels)
    every = stride(camera, 1, config)
    ref = make_reference(reference.image, camera, config, 1, reference.seen, reference.spread)
    obs = make_observed(image, camera, 1, every)
    terms = linearise(T, ref, obs, camera, 1, config)
    twists = se3_adjoint(T) @ basis
    # By a translation the point moves along the normal of its plane: that part of the Jacobian is -n / sigma.
    normal = -terms[0].jacobian[:3]
    precision = jnp.linalg.norm(normal, axis=0)  # 1 / sigma
    T_world_cam = reference.T_world_cam @ T
    points = T_world_cam[:3, :3] @ obs.points + T_world_cam[:3, 3][:, None]
    slots = _slots(points, reference.T_world_cam[:3, :3] @ normal, surface.patch, SLOTS)
    jacobians = [twists.T @ term.jacobian for term in terms]
    weighted = [J * term.weight for J, term in zip(jacobians, terms, strict=True)]
    every_J, every_wJ = jnp.concatenate(jacobians, axis=1), jnp.concatenate(weighted, axis=1)
    H = every_wJ @ every_J.T
    noise = every_wJ @ every_wJ.T * (used / every) ** 2
    weight = terms[0].weight * precision
    colour = sum(wJ * term.residual for wJ, term in zip(weighted[1:], terms[1:], strict=True))
    rows = [jacobians[0] * weight, colour, (weight * precision)[None], (weight * terms[0].residual)[None]]
    p = basis.shape[1]
    summed = jax.ops.segment_sum(jnp.concatenate(rows).T, slots, SLOTS)
    shifts, colours, total, mean = summed[:, :p], summed[:, p : 2 * p], summed[:, 2 * p], summed[:, 2 * p + 1]
    # Within a patch errors vary: pieces are displaced with their texture, and their colours blurred, each by itself.
    pieces = _slots(points, reference.T_world_cam[:3, :3] @ normal, surface.piece, PIECES)
    along = weighted[0][:, None] * terms[0].jacobian[:3] + weighted[1][:, None] * terms[1].jacobian[:3]
    apart = jax.ops.segment_sum(jnp.concatenate([along.reshape(3 * p, -1), colour]).T, pieces, PIECES)
    shift = reference.displacement * apart[:, : 3 * p].reshape(-1, p, 3)
    blur = apart[:, 3 * p :]
    noise += jnp.einsum("bia,bja->ij", shift, shift) + blur.T @ blur
    variance = _variance(shifts, total, mean / jnp.maximum(total, 1e-9), H, reference.displacement, surface)
    return Influence(H, noise, jnp.concatenate([-shifts * jnp.sqrt(variance)[:, None], -colours]))


def _slots(
    points: Float[Array, "3 pixels"], normals: Float[Array, "3 pixels"], edge: float, count: int
) -> Int[Array, "pixels"]:
    """Return the slot of each point's patch: its cube and the axis that its normal is nearest to, hashed."""
    axis = jnp.argmax(jnp.abs(normals), axis=0)
    facing = jnp.take_along_axis(normals, axis[None], axis=0)[0] > 0.0
    cells = [*jnp.floor(points / edge).astype(jnp.int32), 2 * axis + facing]
    mixed = jnp.zeros(points.shape[1], jnp.uint32)
    for cell, prime in zip(cells, _PRIMES, strict=True):
        mixed ^= cell.astype(jnp.uint32) * jnp.uint32(prime)
    return (mixed % count).astype(jnp.int32)


def _variance(
    shifts: Float[Array, "slots p"],
    total: Float[Array, "slots"],
    residual: Float[Array, "slots"],
    H: Float[Array, "p p"],
    displacement: Float[Array, ""],
    surface: SurfaceErrorConfig,
) -> Float[Array, "slots"]:
    """``tau_0^2 + (r / (1 - h))^2``: the variance of each patch's displacement, m^2 (eq. I16).

    ``h`` is the share of its displacement that a patch turns into a motion of the pose, which no residual shows.
    """
    weak = 1e-6 * jnp.eye(len(H)) * (1.0 + jnp.trace(H))
    absorbed = jnp.sum((shifts @ jnp.linalg.inv(H + weak)) * shifts, axis=1) / jnp.maximum(total, 1e-9)
    left = jnp.maximum(1.0 - absorbed, surface.least_residual)
    return displacement**2 + (residual / left) ** 2
