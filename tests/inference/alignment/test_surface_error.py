"""Test what errors of surfaces do to an alignment, against sums over pixels in float64 and displaced surfaces."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import Room, camera_pose
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_adjoint, se3_exp
from vssm_gym.inference.alignment import reference_view, surface_error
from vssm_gym.inference.alignment.residuals import AlignConfig, linearise, make_observed, make_reference, stride
from vssm_gym.inference.alignment.surface_error import SLOTS, Influence, SurfaceErrorConfig

CAMERA = Camera.from_hfov(64, 48, np.radians(85))
ROOM = Room(((-1.9, -1.6, 0.0), (1.9, 1.6, 2.0)), (((0.9, 0.6, 0.0), (1.4, 1.1, 0.8)),))
HERE = camera_pose((-0.8, -0.3, 1.1), 0.4, 0.2)
CONFIG, SURFACE = AlignConfig(), SurfaceErrorConfig(pixels=3072)
BASIS = np.eye(6)[:, [0, 2, 4]]


def found(twist: np.ndarray, surface: SurfaceErrorConfig = SURFACE) -> tuple[Influence, np.ndarray]:
    """Return the influence at a pose beside the true one, and that pose, T_ref_cam."""
    reference = reference_view.of_image(jnp.asarray(HERE, jnp.float32), ROOM.image(HERE, CAMERA))
    T = se3_exp(jnp.asarray(twist, jnp.float32))
    image = ROOM.image(HERE, CAMERA)
    basis = jnp.asarray(BASIS, jnp.float32)
    return surface_error.influence(T, basis, reference, image, CAMERA, CONFIG, surface), np.asarray(T, float)


@pytest.mark.parametrize("seed", range(3))
def test_the_influence_is_the_sum_over_the_pixels_of_each_patch(seed: int) -> None:
    """Group pixels by cube and normal with dictionaries, and sum their gradients in float64."""
    twist = 0.01 * np.random.default_rng(seed).standard_normal(6)
    got, T = found(twist)
    ref = make_reference(ROOM.image(HERE, CAMERA), CAMERA, CONFIG)
    obs = make_observed(ROOM.image(HERE, CAMERA), CAMERA, 1, stride(CAMERA, 1, CONFIG))
    geometry, colour = linearise(jnp.asarray(T, jnp.float32), ref, obs, CAMERA, 1, CONFIG)
    B = np.asarray(se3_adjoint(jnp.asarray(T, jnp.float32)), float) @ BASIS
    w, r, J = (np.asarray(a, float) for a in (geometry.weight, geometry.residual, geometry.jacobian))
    wc, rc, Jc = (np.asarray(a, float) for a in (colour.weight, colour.residual, colour.jacobian))
    JB, JcB = B.T @ J, B.T @ Jc
    H = (JB * w) @ JB.T + (JcB * wc) @ JcB.T
    np.testing.assert_allclose(got.curvature, H, rtol=2e-3, atol=1e-3 * np.abs(H).max())
    T_world_cam = HERE @ T
    points = T_world_cam[:3, :3] @ np.asarray(obs.points, float) + T_world_cam[:3, 3:]
    normals = -HERE[:3, :3] @ J[:3]

    def cubes(edge: float) -> list[list[int]]:
        groups: dict[tuple, list[int]] = {}
        for i in range(points.shape[1]):
            axis = int(np.argmax(np.abs(normals[:, i])))
            key = (*np.floor(points[:, i] / edge).astype(int), axis, bool(normals[axis, i] > 0))
            groups.setdefault(key, []).append(i)
        return list(groups.values())

    N, tau0 = (JB * w**2) @ JB.T + (JcB * wc**2) @ JcB.T, reference_view.TAKEN
    inverse_sigma = np.linalg.norm(J[:3], axis=0)
    for pixels in cubes(SURFACE.piece):
        shift = JB[:, pixels] @ (w[pixels] * J[:3, pixels]).T + JcB[:, pixels] @ (wc[pixels] * Jc[:3, pixels]).T
        shift *= tau0  # along each axis: the surface, and its texture
        blur = JcB[:, pixels] @ (wc[pixels] * rc[pixels])
        N += shift @ shift.T + np.outer(blur, blur)
    # Pixels on the border of two cubes, and cubes of one slot, differ from the dictionaries'.
    scale = np.sqrt(np.diag(N))
    np.testing.assert_allclose(got.noise / np.outer(scale, scale), N / np.outer(scale, scale), atol=0.1)
    S = N.copy()
    for pixels in cubes(SURFACE.patch):
        s = inverse_sigma[pixels]
        shift = JB[:, pixels] @ (w[pixels] * s)
        total = np.sum(w[pixels] * s**2)
        if total > 0:
            mean = np.sum(w[pixels] * s * r[pixels]) / total
            absorbed = shift @ np.linalg.solve(H, shift) / total
            S += np.outer(shift, shift) * (tau0**2 + (mean / max(1 - absorbed, SURFACE.least_residual)) ** 2)
        colours = JcB[:, pixels] @ (wc[pixels] * rc[pixels])
        S += np.outer(colours, colours)
    scale = np.sqrt(np.diag(S))
    np.testing.assert_allclose(got.covariance / np.outer(scale, scale), S / np.outer(scale, scale), atol=0.1)


def test_a_displaced_surface_moves_the_estimate_as_its_influence_says() -> None:
    """Push one wall of the reference by a displacement: the gradient changes by its influence times that."""
    push = 0.004
    influence, _ = found(np.zeros(6))
    deeper = Room(((-1.9, -1.6, 0.0), (1.9 + push, 1.6, 2.0)), ROOM.boxes)
    ref = make_reference(deeper.image(HERE, CAMERA), CAMERA, CONFIG)
    obs = make_observed(ROOM.image(HERE, CAMERA), CAMERA, 1, stride(CAMERA, 1, CONFIG))
    geometry, _ = linearise(jnp.eye(4), ref, obs, CAMERA, 1, replace(CONFIG, huber=1e6))
    gradient = BASIS.T @ np.asarray((geometry.jacobian * geometry.weight) @ geometry.residual, float)
    points = HERE[:3, :3] @ np.asarray(obs.points, float) + HERE[:3, 3:]
    facing = jnp.zeros_like(obs.points).at[0].set(-1.0)
    slots = np.asarray(surface_error._slots(jnp.asarray(points, jnp.float32), facing, SURFACE.patch, SLOTS))
    of_wall = np.unique(slots[points[0] > 1.85])
    rows = np.asarray(influence.surfaces, float)[:SLOTS][of_wall]
    # A surface that is further away by ``push`` is displaced against its normal.
    expected = rows.sum(axis=0) / reference_view.TAKEN * -push
    np.testing.assert_allclose(-gradient, expected, rtol=0.15, atol=0.02 * np.abs(expected).max())


def test_correlation_is_one_for_independent_data_and_grows_with_shared_errors() -> None:
    H = jnp.diag(jnp.asarray([3.0, 10.0, 200.0]))
    K = jnp.linalg.inv(H + 2.0 * jnp.eye(3))
    independent = Influence(H, H, jnp.zeros((4, 3)))
    assert float(independent.correlation(K)) == pytest.approx(1.0, rel=1e-5)
    shared = eqx.tree_at(lambda i: i.surfaces, independent, jnp.sqrt(H)[:3] * 2.0)
    shared = Influence(H, H, jnp.concatenate([shared.surfaces, jnp.zeros((1, 3))]))
    assert float(shared.correlation(K)) == pytest.approx(5.0, rel=1e-5)
    assert np.isfinite(float(Influence(0.0 * H, 0.0 * H, jnp.zeros((4, 3))).correlation(K)))
