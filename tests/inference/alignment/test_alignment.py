"""Test the MAP pose: known motions are recovered, the prior fills unobserved directions, derivatives are exact."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.analytic_room import Room, camera_pose, slab
from tests.helpers.localisation_room import CAMERA, ROOM, known_map
from tests.helpers.random_maps import seeds
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import inverse, se3_adjoint, se3_exp, se3_log
from vssm_gym.inference.alignment.gauss_newton import align
from vssm_gym.inference.alignment.residuals import (
    AlignConfig,
    Term,
    alignment_cost,
    fit_quality,
    linearise,
    luminance,
    make_observed,
    make_reference,
    normal_equations,
    score,
    shrink_camera,
    shrink_rgbd,
    stride,
)
from vssm_gym.model.emission import RGBD, render

CONFIG = AlignConfig()
FREE, NO_PRIOR, IDENTITY = jnp.eye(6), 1e-3 * jnp.eye(6), jnp.eye(4)
align_jit = jax.jit(align, static_argnums=7)
disagree_jit = jax.jit(alignment_cost, static_argnums=(4, 5))


def f32(a: np.ndarray) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def solve(reference: RGBD, observed: RGBD, prior=IDENTITY, precision=NO_PRIOR, start=None, basis=FREE):
    start = prior if start is None else start
    return align_jit(f32(prior), f32(precision), f32(start), basis, reference, observed, CAMERA, CONFIG)


def room_pose(rng: np.random.Generator) -> np.ndarray:
    return camera_pose(
        (*rng.uniform([-0.9, -0.5, 0.4], [0.1, 0.5, 0.8]),), *rng.uniform(-0.5, 0.5, 3) * [1.2, 0.4, 0.4]
    )


def motion(rng: np.random.Generator, metres: float, radians: float) -> np.ndarray:
    """Draw T_ref_cam of a random direction; float64."""
    t, r = rng.standard_normal((2, 3))
    delta = np.concatenate([metres * t / np.linalg.norm(t), radians * r / np.linalg.norm(r)])
    return np.asarray(se3_exp(f32(delta)), float)


def errors(T: jax.Array, truth: np.ndarray) -> tuple[float, float]:
    """Return metres and radians between two poses."""
    delta = np.asarray(se3_log(f32(np.linalg.inv(truth) @ np.asarray(T, float))))
    return float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:]))


@settings(max_examples=12)
@given(seeds, st.floats(0.0, 0.08), st.floats(0.0, 0.08))
def test_a_known_motion_is_recovered_from_images(seed: int, metres: float, radians: float) -> None:
    """Two ideal images up to 8 cm and 4.6 degrees apart: 2 mm and 0.1 degrees."""
    rng = np.random.default_rng(seed)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, metres, radians)
    T, info = solve(ROOM.image(T_world_ref, CAMERA), ROOM.image(T_world_ref @ T_ref_cam, CAMERA))
    off, turned = errors(T, T_ref_cam)
    assert off < 2e-3
    assert turned < 2e-3
    assert float(info.inlier_share) > 0.97
    assert 0.4 < float(info.coverage) <= 1.0


@settings(max_examples=12)
@given(seeds, st.floats(0.0, 0.08), st.floats(0.0, 0.08))
def test_a_known_motion_is_recovered_from_the_map(seed: int, metres: float, radians: float) -> None:
    """Aligned to a render of 10 cm cells, which blurs edges and colours, the error is below a twentieth of a cell."""
    rng = np.random.default_rng(seed)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, metres, radians)
    T, info = solve(render(known_map(), f32(T_world_ref), CAMERA), ROOM.image(T_world_ref @ T_ref_cam, CAMERA))
    off, turned = errors(T, T_ref_cam)
    assert off < 6e-3
    assert turned < 4e-3
    assert float(info.photometric) < 1.0


def test_the_true_pose_is_a_fixed_point() -> None:
    T_world_ref = room_pose(np.random.default_rng(1))
    image = ROOM.image(T_world_ref, CAMERA)
    T, info = solve(image, image)
    np.testing.assert_allclose(np.asarray(T), np.eye(4), atol=1e-5)
    assert float(info.inlier_share) == 1.0
    assert float(info.photometric) < 1e-3


@given(seeds)
def test_the_start_does_not_matter(seed: int) -> None:
    """Two starts, 5 cm and 3 degrees around the optimum, converge to it, with a prior that is off to one side."""
    rng = np.random.default_rng(seed)
    T_world_ref = room_pose(np.random.default_rng(3))
    reference, observed = (ROOM.image(T, CAMERA) for T in (T_world_ref, T_world_ref @ motion(rng, 0.02, 0.02)))
    prior = motion(rng, 0.02, 0.02)
    a, b = (solve(reference, observed, prior, 1e3 * np.eye(6), prior @ motion(rng, 0.05, 0.05))[0] for _ in range(2))
    np.testing.assert_allclose(np.asarray(a), np.asarray(b), atol=3e-4)


def planar_basis(T_body_cam: np.ndarray) -> jax.Array:
    return se3_adjoint(f32(np.linalg.inv(T_body_cam))) @ jnp.eye(6)[:, jnp.array([0, 1, 5])]


@given(seeds)
def test_a_planar_robot_stays_on_its_floor(seed: int) -> None:
    """The images show a motion with height, roll and pitch, and the basis excludes it exactly."""
    rng = np.random.default_rng(seed)
    T_body_cam = camera_pose((0.05, 0.0, 0.4), 0.2, 0.1)
    T_world_body = np.eye(4)
    T_world_body[:2, 3] = rng.uniform(-0.4, 0.4, 2)
    T_world_ref = T_world_body @ T_body_cam
    observed = ROOM.image(T_world_ref @ motion(rng, 0.05, 0.05), CAMERA)
    T, info = solve(
        ROOM.image(T_world_ref, CAMERA), observed, precision=1e-3 * np.eye(3), basis=planar_basis(T_body_cam)
    )
    moved = T_body_cam @ np.asarray(T, float) @ np.linalg.inv(T_body_cam)  # of the body, in its old frame
    np.testing.assert_allclose(moved[2], [0.0, 0.0, 1.0, 0.0], atol=2e-6)
    np.testing.assert_allclose(moved[:2, 2], 0.0, atol=2e-6)
    assert info.information.shape == (3, 3)


@given(seeds)
def test_information_is_symmetric_and_positive(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T_world_ref = room_pose(rng)
    _, info = solve(ROOM.image(T_world_ref, CAMERA), ROOM.image(T_world_ref @ motion(rng, 0.05, 0.05), CAMERA))
    information = np.asarray(info.information, float)
    np.testing.assert_allclose(information, information.T, rtol=1e-4, atol=1e-2)
    assert np.linalg.eigvalsh(information).min() > 1.0  # a furnished, textured room fixes all six coordinates


def blank(image: RGBD) -> RGBD:
    return RGBD(0 * image.depth, 0 * image.rgb, jnp.zeros_like(image.hit), jnp.zeros_like(image.known))


@pytest.mark.parametrize("empty", ["reference", "observed", "both"])
def test_without_an_image_the_posterior_is_the_prior(empty: str) -> None:
    """The posterior mode is the prior's mean from every start, and the images add no information."""
    rng = np.random.default_rng(5)
    image = ROOM.image(room_pose(rng), CAMERA)
    prior = motion(rng, 0.3, 0.3)
    reference = blank(image) if empty != "observed" else image
    observed = blank(image) if empty != "reference" else image
    T, info = solve(reference, observed, prior, np.diag([1e4, 1e4, 1e4, 1e3, 1e3, 1e3]), prior @ motion(rng, 0.1, 0.1))
    np.testing.assert_allclose(np.asarray(T), prior, atol=1e-4)
    assert float(info.inlier_share) == 0.0
    assert float(info.coverage) == 0.0
    np.testing.assert_array_equal(np.asarray(info.information), 0.0)


def test_a_blank_wall_determines_distance_and_tilt_only() -> None:
    """Before one plane of one colour, the prior's mean remains along it and about its normal."""
    interior = ((-9.0, -9.0, -9.0), (1.5, 9.0, 9.0))
    wall = Room(interior)
    T_world_ref, T_ref_cam = camera_pose((0.0, 0.0, 0.0), 0.0), np.eye(4)
    T_ref_cam[:3, 3] = [0.03, -0.02, 0.04]  # camera axes: right, down, ahead

    def grey(image: RGBD) -> RGBD:
        return RGBD(image.depth, 0 * image.rgb + 0.5, image.hit, image.known)

    reference = grey(wall.image(T_world_ref, CAMERA))
    observed = grey(wall.image(T_world_ref @ T_ref_cam, CAMERA))
    T, info = solve(reference, observed, precision=10.0 * np.eye(6))
    np.testing.assert_allclose(np.asarray(T)[:3, 3], [0.0, 0.0, 0.04], atol=1e-3)
    np.testing.assert_allclose(np.asarray(T)[:3, :3], np.eye(3), atol=1e-3)
    values, vectors = np.linalg.eigh(np.asarray(info.information, float))
    assert (values[:3] < 1e-3 * values[3:].min()).all()  # right, down and roll
    np.testing.assert_allclose(np.abs(vectors[[2, 3, 4], :3]).max(), 0.0, atol=1e-2)
    assert slab(np.zeros(3), np.array([[1.0, 0, 0]]), interior)[1] == 1.5


def test_the_information_of_a_wall_by_hand() -> None:
    """``n z z^T / (30 sigma^2)`` of a wall of one colour at 1.5 m, ``sigma = 4 mm + 2.5 mm/m^2 (1.5 m)^2``.

    Each of the ``n`` pixels with a plane, all but the image's rim, measures the distance with the std of one reading,
    and 30 of them count as one. A pixel at height ``y`` on the wall has the lever arm ``y`` about the x axis.
    """
    T_world_ref = camera_pose((0.0, 0.0, 0.0), 0.0)
    image = Room(((-9.0, -9.0, -9.0), (1.5, 9.0, 9.0))).image(T_world_ref, CAMERA)
    image = RGBD(image.depth, 0 * image.rgb + 0.5, image.hit, image.known)
    info = fit_quality(
        IDENTITY, FREE, make_reference(image, CAMERA, CONFIG), make_observed(image, CAMERA), CAMERA, CONFIG, 0
    )
    sigma = 0.004 + 0.0025 * 1.5**2
    y = 1.5 * (np.arange(1, 47) - CAMERA.cy) / CAMERA.fy
    across, about = 46 * 62 / (30 * sigma**2), 62 * np.sum(y**2) / (30 * sigma**2)
    found = np.asarray(info.information, float)
    assert found[2, 2] == pytest.approx(across, rel=1e-3)  # along the camera's axis
    assert found[3, 3] == pytest.approx(about, rel=1e-3)  # about the image's horizontal axis
    np.testing.assert_allclose(found[[0, 1, 5]], 0.0, atol=1e-3 * across)  # along the wall, and about its normal


@pytest.mark.parametrize("away", [0.0, 0.01, 0.05, 0.2])
def test_the_influence_of_a_residual_is_bounded(away: float) -> None:
    """``w r`` is the residual up to Huber's elbow and the elbow beyond it, times the pixel's share of a datum."""
    image = ROOM.image(room_pose(np.random.default_rng(2)), CAMERA)
    for term, share in zip(terms_at(IDENTITY.at[2, 3].set(away), image, image), (1.0, CONFIG.rgb_weight), strict=True):
        r, influence = np.asarray(term.residual, float), np.asarray(term.weight * term.residual, float)
        used = np.asarray(term.weight) > 0.0
        assert used.any()
        expected = share / CONFIG.pixels_per_datum * np.clip(r, -CONFIG.huber, CONFIG.huber)
        np.testing.assert_allclose(influence[used], expected[used], rtol=1e-4, atol=1e-6)


def test_a_stronger_prior_holds_the_pose_back() -> None:
    """As its precision grows, the estimate moves monotonically from the data's pose to the prior's."""
    rng = np.random.default_rng(7)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, 0.04, 0.02)
    reference, observed = ROOM.image(T_world_ref, CAMERA), ROOM.image(T_world_ref @ T_ref_cam, CAMERA)
    away = [
        errors(solve(reference, observed, precision=p * np.eye(6))[0], np.eye(4))[0] for p in (1e-3, 1e5, 1e7, 1e10)
    ]
    assert away == sorted(away, reverse=True)
    assert away[0] == pytest.approx(0.04, abs=2e-3)
    assert away[-1] < 1e-3


def test_another_place_has_a_low_fit_quality() -> None:
    """Loss of track is decided by the fit quality."""
    here, there = camera_pose((-0.5, 0.0, 0.5), 0.0), camera_pose((0.3, 0.2, 0.9), 2.4, 0.3)
    _, same = solve(ROOM.image(here, CAMERA), ROOM.image(here, CAMERA), precision=1e3 * np.eye(6))
    _, other = solve(ROOM.image(here, CAMERA), ROOM.image(there, CAMERA), precision=1e3 * np.eye(6))
    assert float(score(same)) > 0.95
    assert float(score(other)) < 0.5
    assert float(other.photometric) > 3 * float(same.photometric) + 1.0


def terms_at(T, reference: RGBD, observed: RGBD, factor: int = 1, config: AlignConfig = CONFIG, **more):
    ref = make_reference(reference, CAMERA, config, factor, **more)
    return linearise(T, ref, make_observed(observed, CAMERA, factor), CAMERA, factor, config)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_jacobians_are_those_of_the_residuals(factor: int) -> None:
    """Every term, by a twist in the reference's frame, against central differences in float64."""
    rng = np.random.default_rng(11)
    T_world_ref = room_pose(rng)
    T = np.asarray(motion(rng, 0.03, 0.03), float)
    reference, observed = ROOM.image(T_world_ref, CAMERA), ROOM.image(T_world_ref @ motion(rng, 0.02, 0.02), CAMERA)
    with jax.enable_x64(True):
        wide = jax.tree.map(lambda a: jnp.asarray(np.asarray(a), float if a.dtype == jnp.float32 else a.dtype), (
            reference, observed, 0.9 * luminance(reference.rgb) + 0.02, 0.01 + 0.002 * reference.depth))  # fmt: skip
        reference, observed, seen, spread = wide
        ref = make_reference(reference, CAMERA, CONFIG, factor, seen, spread)
        obs = make_observed(observed, CAMERA, factor)
        at = jax.jit(lambda T: linearise(T, ref, obs, CAMERA, factor, CONFIG))
        middle, h = at(jnp.asarray(T)), 1e-6
        sides = [[at(se3_exp(s * h * jnp.eye(6)[axis]) @ jnp.asarray(T)) for s in (1, -1)] for axis in range(6)]
    assert len(middle) == 3
    for k, term in enumerate(middle):
        used = np.asarray(term.weight) > 0.0
        assert used.mean() > 0.5
        for axis, (high, low) in enumerate(sides):
            slope = (np.asarray(high[k].residual) - np.asarray(low[k].residual)) / (2 * h)
            J = np.asarray(term.jacobian[axis])
            wrong = np.abs(slope - J) > 1e-4 * np.abs(J).max()
            assert np.mean(wrong[used]) < 1e-3  # those that crossed into the next pixel


def test_normal_equations_are_weighted_sums() -> None:
    """``sum w J J^T`` and ``sum w J r`` over all terms, in float64."""
    rng = np.random.default_rng(6)
    terms = [
        Term(
            *(f32(a) for a in (rng.normal(size=50), rng.uniform(size=50), rng.normal(size=(6, 50)))), jnp.ones(50, bool)
        )
        for _ in range(3)
    ]
    H, g = normal_equations(*terms)
    J, w, r = (np.concatenate([np.asarray(t[i], float) for t in terms], -1) for i in (2, 1, 0))
    np.testing.assert_allclose(np.asarray(H), (J * w) @ J.T, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(np.asarray(g), (J * w) @ r, rtol=1e-4, atol=1e-4)


def information(T_world_ref, T_ref_cam, config: AlignConfig = CONFIG, **more) -> np.ndarray:
    """Return the information of the data at the solution."""
    reference, observed = ROOM.image(T_world_ref, CAMERA), ROOM.image(T_world_ref @ T_ref_cam, CAMERA)
    _, info = align_jit(IDENTITY, NO_PRIOR, IDENTITY, FREE, reference, observed, CAMERA, config, **more)
    return np.asarray(info.information, float)


@given(seeds)
def test_an_uncertain_reference_has_less_information(seed: int) -> None:
    """Spread adds to the variance of the planes, which lowers the information in every direction."""
    rng = np.random.default_rng(seed)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, 0.01, 0.01)
    sure, unsure = (information(T_world_ref, T_ref_cam, spread=f32(np.full((48, 64), s))) for s in (0.0, 0.02))
    scale = np.diag(1.0 / np.sqrt(np.diag(sure)))
    assert np.linalg.eigvalsh(scale @ (sure - unsure) @ scale).min() > -0.02  # a pixel at the gate may come in
    assert np.trace(scale @ unsure @ scale) < 0.9 * 6


def test_no_spread_is_a_spread_of_zero() -> None:
    rng = np.random.default_rng(8)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, 0.02, 0.02)
    sure, none = (information(T_world_ref, T_ref_cam, spread=s) for s in (jnp.zeros((48, 64)), None))
    np.testing.assert_allclose(sure, none, rtol=1e-4, atol=1e-3 * np.abs(none).max())


def test_spread_widens_residuals_as_variances_add() -> None:
    """``sigma^2 = (a + b depth^2)^2 + spread^2``, at the pixel of the reference."""
    T_world_ref = room_pose(np.random.default_rng(10))
    image = ROOM.image(T_world_ref, CAMERA)
    spread = np.random.default_rng(0).uniform(0.0, 0.05, (48, 64))
    T = f32(motion(np.random.default_rng(1), 0.002, 0.0))  # well below a pixel: each keeps its own
    plain, wide = terms_at(T, image, image)[0], terms_at(T, image, image, spread=f32(spread))[0]
    depth = np.asarray(image.depth, float).reshape(-1)
    sigma = CONFIG.geo_sigma + CONFIG.geo_sigma_quadratic * depth**2
    used = np.asarray(plain.weight) > 0
    expected = np.asarray(plain.residual, float) * sigma / np.hypot(sigma, spread.reshape(-1))
    np.testing.assert_allclose(np.asarray(wide.residual)[used], expected[used], rtol=1e-3, atol=1e-4)


def test_the_image_at_the_reference_pose_adds_information() -> None:
    """A turn about a wall's normal follows from the image taken there if the rendered image has no texture."""
    rng = np.random.default_rng(12)
    wall = Room(((-9.0, -9.0, -9.0), (1.5, 9.0, 9.0)))
    T_world_ref = camera_pose((0.0, 0.0, 0.0), 0.0)
    T_ref_cam = motion(rng, 0.0, 0.03)
    T_ref_cam[:2, 3] = [0.02, -0.01]
    taken, observed = wall.image(T_world_ref, CAMERA), wall.image(T_world_ref @ T_ref_cam, CAMERA)
    bare = RGBD(taken.depth, 0 * taken.rgb + jnp.mean(luminance(taken.rgb)), taken.hit, taken.known)
    arguments = (IDENTITY, 10.0 * FREE, IDENTITY, FREE, bare, observed, CAMERA, CONFIG)
    without, with_it = align_jit(*arguments)[0], align_jit(*arguments, seen=luminance(taken.rgb))[0]
    assert errors(with_it, T_ref_cam)[0] < 1e-3
    assert errors(without, T_ref_cam)[0] > 0.01


def test_where_the_reference_is_textured_the_image_seen_there_agrees() -> None:
    """The same image twice gives the same pose, with more information."""
    rng = np.random.default_rng(13)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, 0.03, 0.03)
    reference, observed = ROOM.image(T_world_ref, CAMERA), ROOM.image(T_world_ref @ T_ref_cam, CAMERA)
    arguments = (IDENTITY, NO_PRIOR, IDENTITY, FREE, reference, observed, CAMERA, CONFIG)
    (one, of_one), (two, of_two) = align_jit(*arguments), align_jit(*arguments, seen=luminance(reference.rgb))
    assert errors(two, np.asarray(one, float))[0] < 1e-3
    gained = np.asarray(of_two.information - of_one.information, float)
    assert np.linalg.eigvalsh(gained).min() > -1e-3 * np.trace(gained)
    assert np.trace(gained) > 0


def test_fewer_pixels_have_as_much_information() -> None:
    """On a grid of every third pixel each is weighted by the pixels that it replaces."""
    rng = np.random.default_rng(14)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, 0.01, 0.01)
    few = AlignConfig(pixels=340)
    assert (stride(CAMERA, 1, CONFIG), stride(CAMERA, 1, few)) == (1, 3)
    all_of_them, sample = information(T_world_ref, T_ref_cam), information(T_world_ref, T_ref_cam, few)
    values = np.linalg.eigvals(np.linalg.solve(all_of_them, sample)).real
    assert (values > 0.5).all()
    assert (values < 2.0).all()
    assert np.trace(sample) == pytest.approx(np.trace(all_of_them), rel=0.25)


@given(seeds, st.floats(0.02, 0.3))
def test_the_alignment_cost_is_least_at_the_true_pose(seed: int, away: float) -> None:
    """The cost also grows with the distance from the true pose."""
    rng = np.random.default_rng(seed)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, 0.02, 0.02)
    ref = make_reference(ROOM.image(T_world_ref, CAMERA), CAMERA, CONFIG, 2)
    obs = make_observed(ROOM.image(T_world_ref @ T_ref_cam, CAMERA), CAMERA, 2)
    off = T_ref_cam @ motion(rng, away, away)
    there, here = (float(disagree_jit(f32(T), ref, obs, CAMERA, 2, CONFIG)) for T in (off, T_ref_cam))
    assert here < there


def test_a_view_without_overlap_costs_more_than_a_fit_and_less_than_a_misfit() -> None:
    """A pose from which no pixel falls on the reference explains nothing, and contradicts nothing."""
    image = ROOM.image(room_pose(np.random.default_rng(15)), CAMERA)
    ref, obs = make_reference(image, CAMERA, CONFIG, 2), make_observed(image, CAMERA, 2)
    back = np.linalg.inv(camera_pose((0.0, 0.0, 0.0), 0.0)) @ camera_pose((0.0, 0.0, 0.0), 3.1)
    unseen = CONFIG.unseen_cost * (1.0 + CONFIG.rgb_weight)
    assert float(disagree_jit(f32(back), ref, obs, CAMERA, 2, CONFIG)) == pytest.approx(unseen)
    assert float(disagree_jit(IDENTITY, ref, obs, CAMERA, 2, CONFIG)) < 0.5 * unseen
    nearer = make_observed(replace(image, depth=0.7 * image.depth, rgb=1.0 - image.rgb), CAMERA, 2)
    assert float(disagree_jit(IDENTITY, ref, nearer, CAMERA, 2, CONFIG)) > unseen


def faces_of(T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axis (height, width) normal to the face that a pixel sees, and the face's position on it."""
    depth = ROOM.depth(T_world_cam, CAMERA)
    p = T_world_cam[:3, 3] + (np.asarray(CAMERA.rays(), float) * depth[..., None]) @ T_world_cam[:3, :3].T
    planes = np.array([corner for solid in (ROOM.interior, *ROOM.boxes) for corner in solid])  # (faces, axis)
    gap = np.abs(p[..., None, :] - planes)
    nearest = gap.reshape(*depth.shape, -1).argmin(axis=-1)
    return nearest % 3, planes.reshape(-1)[nearest]


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_planes_of_the_reference_are_those_of_the_room(factor: int) -> None:
    """A pixel whose four neighbours see the same face gets that face's plane, to 0.1 mm."""
    T = room_pose(np.random.default_rng(2))
    plane = np.asarray(make_reference(ROOM.image(T, CAMERA), CAMERA, CONFIG, factor).plane, float)
    axis, place = (a[factor // 2 :: factor, factor // 2 :: factor] for a in faces_of(T))
    face = 100.0 * axis + place
    alone = np.zeros(face.shape, bool)
    alone[1:-1, 1:-1] = True
    for shift in (1, -1):
        alone &= (np.roll(face, shift, 0) == face) & (np.roll(face, shift, 1) == face)
    assert alone.mean() > 0.3
    normal = (T[:3, :3] @ plane[:3]).reshape(3, *face.shape)
    along = np.take_along_axis(normal, axis[None], 0)[0]
    np.testing.assert_allclose(np.abs(along[alone]), 1.0, atol=1e-5)
    offset = plane[3].reshape(face.shape) + np.einsum("i,i...->...", T[:3, 3], normal)  # <n, p_world>
    np.testing.assert_allclose(offset[alone] / along[alone], place[alone], atol=1e-4)


def test_pixels_at_depth_jumps_are_left_out() -> None:
    """A plane fitted across the edge of a box is not a surface."""
    T = camera_pose((-0.5, 0.6, 0.5), 0.15)
    image = ROOM.image(T, CAMERA)
    reference = make_reference(image, CAMERA, CONFIG)
    depth = np.asarray(image.depth)
    jump = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        for shift in (1, -1):
            jump |= np.abs(np.roll(depth, shift, axis) - depth) > 0.3 * depth
    used = np.linalg.norm(np.asarray(reference.plane)[:3], axis=0).reshape(depth.shape) > 0.5
    assert jump[1:-1, 1:-1].sum() > 10
    assert not (used & jump)[1:-1, 1:-1].any()


def test_unknown_surfaces_are_not_aligned_to() -> None:
    image = ROOM.image(room_pose(np.random.default_rng(4)), CAMERA)
    left = jnp.zeros_like(image.known).at[:, :32].set(True)
    reference = make_reference(RGBD(image.depth, image.rgb, image.hit, left), CAMERA, CONFIG)
    used = np.linalg.norm(np.asarray(reference.plane)[:3], axis=0).reshape(48, 64) > 0.5
    assert used[:, 1:31].mean() > 0.5
    assert not used[:, 31:].any()
    assert not np.asarray(reference.textured).reshape(48, 64)[:, 31:].any()


@pytest.mark.parametrize(("width", "height", "factor"), [(64, 48, 4), (100, 75, 2), (424, 240, 21)])
def test_shrunk_pixels_are_kept_pixels(width: int, height: int, factor: int) -> None:
    """Pixel i of the shrunk camera has the ray of pixel o + i f of the full one, also where f does not divide."""
    full = Camera.from_hfov(width, height, 1.2)
    small = shrink_camera(full, factor)
    o = factor // 2
    kept = full.rays()[o::factor, o::factor][: small.height, : small.width]
    np.testing.assert_allclose(np.asarray(small.rays()), np.asarray(kept), atol=1e-5)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_an_image_aligned_to_itself_stays(factor: int) -> None:
    """This holds at each level alone, because shrinking must not shift colour against depth."""
    image = ROOM.image(room_pose(np.random.default_rng(4)), CAMERA)
    config = AlignConfig(levels=(factor,), iterations=(6,))
    T, _ = align_jit(IDENTITY, NO_PRIOR, IDENTITY, FREE, image, image, CAMERA, config)
    np.testing.assert_allclose(np.asarray(T), np.eye(4), atol=1e-5)


def test_an_image_shrunk_twice_is_an_image_shrunk_once() -> None:
    """Shrinking by 2 and 2 equals shrinking by 4, up to the choice of the reading nearest to a block's centre."""
    image = ROOM.image(room_pose(np.random.default_rng(4)), CAMERA)
    twice, once = shrink_rgbd(shrink_rgbd(image, 2), 2), shrink_rgbd(image, 4)
    np.testing.assert_allclose(np.asarray(twice.rgb), np.asarray(once.rgb), atol=1e-6)
    assert twice.depth.shape == once.depth.shape == (12, 16)
    np.testing.assert_array_equal(np.asarray(once.depth), np.asarray(image.depth)[2::4, 2::4])


def test_aligning_compiles_once() -> None:
    before = align_jit._cache_size()
    rng = np.random.default_rng(0)
    for _ in range(3):
        T = room_pose(rng)
        solve(ROOM.image(T, CAMERA), ROOM.image(T @ motion(rng, 0.02, 0.02), CAMERA), motion(rng, 0.01, 0.01))
    assert align_jit._cache_size() - before <= 1


def test_inverse_is_used_consistently() -> None:
    """Swapping the images inverts the motion."""
    rng = np.random.default_rng(9)
    T_world_ref, T_ref_cam = room_pose(rng), motion(rng, 0.04, 0.03)
    a, b = ROOM.image(T_world_ref, CAMERA), ROOM.image(T_world_ref @ T_ref_cam, CAMERA)
    forth, back = solve(a, b)[0], solve(b, a)[0]
    np.testing.assert_allclose(np.asarray(forth), np.asarray(inverse(back)), atol=4e-3)
