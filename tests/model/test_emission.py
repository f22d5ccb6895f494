"""Test the renderer: the fast search against every sample of the march, closed-form depths, gradients."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.analytic_room import Room, camera_pose, ray_directions
from tests.helpers.field_oracle import FieldOracle
from tests.helpers.random_maps import ORIGIN, SHAPE, VOXEL, kinds, random_map, seeds
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.inference.mapping import map_update
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import MAX_DEPTH, RGBD, STEP, march, render, render_with, search

RAYS = 192
E = STEP * VOXEL  # m between samples
CAMERA = Camera.from_hfov(16, 12, np.radians(80))
# 2.3 m of room in a grid of 2.4 x 2.4 x 1.6 m: walls stand 0.1 m and more inside the grid
ROOM = Room(interior=((-1.08, -0.77, 0.42), (0.98, 1.22, 1.68)), boxes=(((0.1, 0.3, 0.42), (0.5, 0.7, 0.93)),))

search_jit, march_jit = jax.jit(search), jax.jit(march)  # compiling a search takes seconds: one shape serves all tests


@functools.cache
def known_map() -> VoxelMap:
    return ROOM.to_map(ORIGIN, VOXEL, SHAPE)


def f32(a: np.ndarray) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def look(m: VoxelMap, T_world_cam: np.ndarray, max_depth: float = MAX_DEPTH, camera: Camera = CAMERA) -> RGBD:
    """Render a map with one fixed signature, so that it compiles once."""
    return render(m, f32(T_world_cam), camera, max_depth)


def on_face(m: VoxelMap, p: np.ndarray) -> np.ndarray:
    """Return points within a thousandth of a cell of the planes that end the grid."""
    g = (p - np.asarray(m.origin, float)) / VOXEL
    return np.minimum(np.abs(g), np.abs(g - np.array(m.shape) + 1)).min(axis=-1) < 1e-3


def assert_same_hits(m: VoxelMap, centre: np.ndarray, directions: np.ndarray) -> float:
    """Assert that ``search`` finds ``march``'s sample on every ray, except at samples of zero occupancy.

    Returns the share of rays with such a sample.
    """
    centre, directions = f32(centre), f32(directions)
    k, hit = map(np.asarray, search_jit(m, centre, directions))
    k_march, hit_march = map(np.asarray, march_jit(m, centre, directions))
    k, k_march = np.where(hit, k, 0), np.where(hit_march, k_march, 0)
    differ = np.flatnonzero(k != k_march)
    first = np.where(np.minimum(k, k_march) > 0, np.minimum(k, k_march), np.maximum(k, k_march))[differ]
    p = np.asarray(centre, float) + np.asarray(directions, float)[differ] * first[:, None] * E
    scale = float(jnp.abs(m.occupancy).max())
    disputed = FieldOracle.of(m)(p)[:, 0]
    # On a face of the grid rounding decides whether a sample is inside; elsewhere the field there must be zero.
    assert ((np.abs(disputed) < 2e-4 * scale) | on_face(m, p)).all(), (k[differ], k_march[differ], disputed)
    return len(differ) / len(k)


@given(kinds, seeds)
def test_search_finds_the_hits_of_the_march(kind: str, seed: int) -> None:
    """Draw random rays from inside and outside the grid, a third of them parallel to one or two faces, a few across the
    diagonals of cubes; as long as a camera's, 1 at the middle of the image and more towards its corners."""
    rng = np.random.default_rng([seed, 2])
    extent = VOXEL * np.array(SHAPE)
    centre = ORIGIN + extent * rng.uniform(-0.5, 1.5, 3)
    towards = ORIGIN + extent * rng.uniform(size=(RAYS, 3)) - centre
    towards[: RAYS // 6, rng.integers(3)] = 0.0
    towards[-RAYS // 8 :] = rng.choice([-1.0, 1.0], 3) + rng.uniform(-0.05, 0.05, (RAYS // 8, 3))
    length = np.maximum(rng.uniform(0.7, 1.6, (RAYS, 1)), 1.0)
    directions = towards / np.linalg.norm(towards, axis=1, keepdims=True) * length
    directions[RAYS // 6 : RAYS // 3] = np.eye(3)[rng.integers(3, size=RAYS // 6)] * rng.choice([-1.0, 1.0])
    assert assert_same_hits(random_map(kind, seed), centre, directions) <= 0.02


@given(kinds, seeds, st.sampled_from([0.0, 0.5, 0.25]))
def test_search_finds_the_hits_from_the_lattice(kind: str, seed: int, fraction: float) -> None:
    """The rays start on cell centres and run exactly along the planes between cubes, or across their edges."""
    rng = np.random.default_rng([seed, 3])
    centre = np.array(ORIGIN) + VOXEL * (rng.integers(-4, 28, 3) + fraction)
    directions = rng.integers(-1, 2, (RAYS, 3)).astype(float)
    directions[(directions == 0.0).all(axis=1)] = [1.0, 0.0, 0.0]
    directions[::2] /= np.linalg.norm(directions[::2], axis=1, keepdims=True)  # the most samples a cube can hold
    assert_same_hits(random_map(kind, seed), centre, directions)


@given(kinds, seeds)
def test_march_takes_the_first_sample_above_the_threshold(kind: str, seed: int) -> None:
    """The reference search agrees with the definition in float64, sample by sample."""
    m, rng = random_map(kind, seed), np.random.default_rng([seed, 4])
    centre = ORIGIN + VOXEL * np.array(SHAPE) * rng.uniform(-0.2, 1.2, 3)
    directions = rng.uniform(-1.2, 1.2, (RAYS, 3))
    directions[:, 0] = rng.choice([-1.0, 1.0], RAYS)
    k, hit = map(np.asarray, march_jit(m, f32(centre), f32(directions)))
    expected_k, expected_hit, o = FieldOracle.of(m).first_hit(
        np.asarray(f32(centre), float), np.asarray(f32(directions), float)
    )
    clear = np.abs(o).min(axis=1) > 1e-4  # no sample near the threshold: rounding cannot matter
    np.testing.assert_array_equal(hit[clear], expected_hit[clear])
    np.testing.assert_array_equal(np.where(hit, k, 0)[clear], np.where(expected_hit, expected_k, 0)[clear])


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_parallel_ray_beside_the_grid_ends(axis: int, side: int) -> None:
    """The search ends at once for a ray that never meets the grid, although it "enters" at sample 1e9 or beyond."""
    m = random_map("empty", 0)
    low, high = np.array(ORIGIN), np.array(ORIGIN) + VOXEL * (np.array(SHAPE) - 1)
    for beside in np.ndindex(2, 2):
        centre = 0.5 * (low + high)
        for other, above in zip([a for a in range(3) if a != axis], beside, strict=True):
            centre[other] = high[other] + 0.37 if above else low[other] - 0.41
        direction = np.zeros((RAYS, 3))
        direction[:, axis] = side
        for tilt in (0.0, 1e-9, 1e-8):
            _, hit = search_jit(m, f32(centre), f32(direction + tilt))
            assert not hit.any()


def test_box_room_depths_are_those_computed_by_hand() -> None:
    """The camera faces a wall 0.98 - (-0.42) = 1.40 m away, and another from the side 0.5 m nearer."""
    image = look(known_map(), camera_pose((-0.42, 0.0, 1.1), 0.0))
    assert bool(image.hit.all())
    assert bool(image.known.all())
    centre = np.asarray(image.depth)[4:8, 6:10]
    np.testing.assert_allclose(centre, 1.40, atol=1e-4)  # z-depth: the same at every pixel of a facing wall
    back = look(known_map(), camera_pose((0.08, 0.0, 1.1), np.pi))
    np.testing.assert_allclose(np.asarray(back.depth)[4:8, 6:10], 0.08 + 1.08, atol=1e-4)


@given(st.floats(-0.8, -0.2), st.floats(-0.5, 0.1), st.floats(-3.1, 3.1), st.floats(-0.6, 0.6), st.floats(-0.5, 0.5))
def test_room_depths_agree_with_the_closed_form(x: float, y: float, yaw: float, pitch: float, roll: float) -> None:
    """Depths are exact on flat surfaces, where the field is affine, from every pose.

    Interpolation rounds edges off, and a pixel at a silhouette may fall on either side of it: few err by half a voxel.
    """
    T = camera_pose((x, y, 1.1), yaw, pitch, roll)
    image = look(known_map(), T)
    truth = ROOM.depth(T, CAMERA)
    p = T[:3, 3] + (np.asarray(CAMERA.rays()) * truth[..., None]) @ T[:3, :3].T
    planes = np.concatenate([np.abs(p - c) for c in (*ROOM.interior, *ROOM.boxes[0])], axis=-1)
    flat = np.sort(planes, axis=-1)[..., 1] > 2 * VOXEL  # no second plane near
    error = np.abs(np.asarray(image.depth) - truth)
    assert bool(image.hit.all())
    assert error[flat].max(initial=0.0) < 1e-5
    assert np.mean(error > 0.5 * VOXEL) < 0.08


@given(seeds)
def test_images_agree_with_the_float64_renderer(seed: int) -> None:
    rng = np.random.default_rng([seed, 5])
    m = random_map("blobs", seed)
    T = camera_pose((-1.4, 0.2, 1.0), *rng.uniform(-0.4, 0.4, 3))
    T = np.asarray(f32(T), float)
    image = look(m, T)
    depth, rgb, k = FieldOracle.of(m).render(T, CAMERA)
    same = (np.asarray(image.hit).ravel() == (k > 0)) & (np.abs(np.asarray(image.depth).ravel() - depth) < 0.5 * E)
    assert same.mean() > 0.98  # a sample on the threshold may fall on either side
    for sample in (k - 1, k):
        same &= ~on_face(m, T[:3, 3] + ray_directions(T, CAMERA) * (sample * E)[:, None])
    np.testing.assert_allclose(np.asarray(image.depth).ravel()[same], depth[same], atol=2e-4)
    np.testing.assert_allclose(np.asarray(image.rgb).reshape(-1, 3)[same], rgb[same], atol=2e-3)


def wall_field(occupancy_of_x: np.ndarray) -> VoxelMap:
    """Return a map that varies along x only."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    dense = np.broadcast_to(occupancy_of_x[:, None, None], SHAPE)
    return m.with_occupancy(m.blocked(f32(dense)))


def test_the_first_sample_never_counts_as_a_hit() -> None:
    """A camera inside a slab that ends 5 mm beyond sample 1 sees the wall that it faces."""
    x = ORIGIN[0] + VOXEL * np.arange(SHAPE[0])
    slab_end = ORIGIN[0] + 5 * VOXEL + 0.005  # occupancy falls through zero here
    m = wall_field(np.where(x < 0.0, slab_end - x, x - 0.5))
    T = f32(camera_pose((slab_end - E - 0.005, 0.25, 1.0), 0.0))
    assert float(m.occupancy_at(T[:3, 3])) > 0.0
    assert float(m.occupancy_at(T[:3, 3] + jnp.array([E, 0.0, 0.0]))) > 0.0  # sample 1 is above the threshold
    image = look(m, T)
    middle = np.asarray(image.depth)[5:7, 7:9]
    np.testing.assert_allclose(middle, 0.5 - float(T[0, 3]), atol=1e-4)


def test_inside_a_solid_the_second_sample_is_the_hit() -> None:
    m = wall_field(np.full(SHAPE[0], 0.1))
    for searcher in (search_jit, march_jit):
        k, hit = searcher(m, f32(np.array([0.0, 0.0, 1.0])), f32(np.eye(3)[np.arange(RAYS) % 3]))
        assert bool(hit.all())
        np.testing.assert_array_equal(np.asarray(k), 2)
    image = look(m, camera_pose((0.0, 0.2, 1.0), 0.3))
    assert float(image.depth.min()) >= 0.99 * E
    assert float(image.depth.max()) <= 2.01 * E


def test_no_hit_is_a_mask_not_a_value() -> None:
    image = look(random_map("empty", 0), camera_pose((0.0, 0.0, 1.0), 0.5))
    for values in (image.depth, image.rgb, image.hit, image.known):
        assert not np.asarray(values).any()


def test_a_pose_that_is_not_a_number_renders_nothing() -> None:
    image = look(known_map(), np.full((4, 4), np.nan))
    assert not bool(image.hit.any())
    assert bool(jnp.isfinite(image.depth).all())


def test_surfaces_beyond_the_depth_range_are_not_seen() -> None:
    """A wall 1.40 m away is out of range at 1.3 m, and in range at 1.5 m."""
    T = camera_pose((-0.42, 0.0, 1.1), 0.0)
    assert not bool(look(known_map(), T, 1.3).hit[4:8, 6:10].any())
    assert bool(look(known_map(), T, 1.5).hit[4:8, 6:10].all())


def test_the_unseen_back_of_a_wall_is_not_known() -> None:
    """Behind the band that images update the field returns to the prior, a zero crossing that is not a surface."""
    room = Room(interior=((-1.2, -0.9, 0.3), (0.5, 1.4, 1.8)))  # a wall from x = 0.5 to the end of the grid
    camera = Camera.from_hfov(20, 15, np.radians(80))
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    for y in (0.0, 0.2, 0.4):
        T = camera_pose((-0.5, y, 1.0), 0.0)
        image = room.image(T, camera)
        m = map_update.update(m, image.depth, image.rgb, f32(T), camera)
    front = look(m, camera_pose((-0.4, 0.2, 1.0), 0.0))
    assert bool(front.known[3:9, 4:12].all())
    back = look(m, camera_pose((1.0, 0.2, 1.0), np.pi))
    assert bool(back.hit[3:9, 4:12].all())
    assert not bool(back.known.any())


def test_rendering_compiles_once() -> None:
    before = render._cache_size()
    for seed in range(3):
        look(random_map("blobs", seed), camera_pose((0.0, 0.1 * seed, 1.0), 0.2 * seed))
    assert render._cache_size() - before <= 1


# --- gradients -----------------------------------------------------------------------------------------------------

WEIGHTS = np.random.default_rng(0).uniform(0.5, 1.5, (CAMERA.height * CAMERA.width, 4))  # of depth and RGB


def loss(theta, rest: VoxelMap, T, mask, searcher) -> jax.Array:
    """``sum w . (depth, rgb)`` over pixels: of the map's means, the pose ``T exp(tangent)`` and (fx, fy, cx, cy)."""
    means, tangent, intrinsics = theta
    m = eqx.tree_at(lambda m: (m.occupancy, m.colour), rest, means)
    image = render_with(searcher, m, T @ se3_exp(tangent), Camera(CAMERA.width, CAMERA.height, *intrinsics))
    values = jnp.concatenate([image.depth.reshape(-1, 1), image.rgb.reshape(-1, 3)], axis=1)
    return jnp.sum(WEIGHTS * mask[:, None] * values)


gradient = jax.jit(jax.grad(loss), static_argnums=4)


@jax.jit
def forward_gradient(theta, direction, rest: VoxelMap, T, mask, hits) -> jax.Array:
    """Return the derivative along a direction, in forward mode, with the search's result given."""
    return jax.jvp(lambda t: loss(t, rest, T, mask, lambda *_: hits), (theta,), (direction,))[1]


VIEWS = {
    "oblique": camera_pose((-0.9, 0.21, 1.03), 0.35, 0.2, 0.1),
    "parallel to faces": camera_pose((-0.93, 0.24, 1.02), 0.0),  # zero rotation: the rays' planes are the grid's
    "from outside": camera_pose((-1.7, 0.31, 1.07), -0.1, 0.05, -0.3),
}
INTRINSICS = (float(CAMERA.fx), float(CAMERA.fy), 7.0, 5.5)  # the column cx = 7 looks along the axis exactly


def theta_at(m: VoxelMap):
    return ((m.occupancy, m.colour), jnp.zeros(6), tuple(jnp.float32(i) for i in INTRINSICS))


def oracle_value(field: FieldOracle, T: np.ndarray, tangent: np.ndarray, intrinsics: np.ndarray, mask: np.ndarray):
    """Return the float64 loss and the samples that were hit."""
    camera = Camera(CAMERA.width, CAMERA.height, *map(float, intrinsics))
    with jax.enable_x64(True):
        moved = T @ np.asarray(se3_exp(jnp.asarray(tangent, jnp.float64)))
    depth, rgb, k = field.render(moved, camera)
    return np.sum(WEIGHTS * mask[:, None] * np.concatenate([depth[:, None], rgb], axis=1)), k


def float32_pose(name: str) -> np.ndarray:
    return np.asarray(f32(VIEWS[name]), float)


def smooth_pixels(m: VoxelMap, T: np.ndarray) -> np.ndarray:
    """Return pixels where float32 and float64 hit the same sample; elsewhere derivatives are undefined."""
    camera = Camera(CAMERA.width, CAMERA.height, *INTRINSICS)
    image = look(m, T, camera=camera)
    depth, _, k = FieldOracle.of(m).render(T, camera)
    return (np.asarray(image.hit).ravel() & (k > 0)) & (np.abs(np.asarray(image.depth).ravel() - depth) < 1e-3)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("seed", [1, 2])
def test_gradients_agree_with_finite_differences(view: str, seed: int) -> None:
    """Cells, pose and intrinsics, against central differences of the float64 renderer."""
    m, T = random_map("blobs", seed), float32_pose(view)
    mask = smooth_pixels(m, T)
    assert mask.sum() > 30
    (d_occupancy, d_colour), d_pose, d_intrinsics = gradient(theta_at(m), m, f32(T), f32(mask), search)
    field, zero, intrinsics, h = FieldOracle.of(m), np.zeros(6), np.array(INTRINSICS), 1e-6

    def difference(evaluate) -> float:
        (high, k_high), (low, k_low) = evaluate(h), evaluate(-h)
        np.testing.assert_array_equal(k_high[mask], k_low[mask])
        return (high - low) / (2 * h)

    pose = [difference(lambda s, a=a: oracle_value(field, T, s * np.eye(6)[a], intrinsics, mask)) for a in range(6)]
    np.testing.assert_allclose(np.asarray(d_pose), pose, rtol=2e-3, atol=2e-3 * np.abs(pose).max())
    lens = [
        difference(lambda s, a=a: oracle_value(field, T, zero, intrinsics + s * np.eye(4)[a], mask)) for a in range(4)
    ]
    np.testing.assert_allclose(np.asarray(d_intrinsics), lens, rtol=2e-3, atol=2e-3 * np.abs(lens).max())

    dense = np.concatenate([np.asarray(m.dense(d_occupancy))[..., None], np.asarray(m.dense(d_colour))], axis=-1)
    assert np.isfinite(dense).all()
    largest = np.argsort(-np.abs(dense), axis=None)[:200]
    for cell in np.random.default_rng(seed).choice(largest, 12, replace=False):
        at = np.unravel_index(cell, dense.shape)

        def nudged(s: float, at=at):
            values = field.values.copy()
            values[at] += s
            return oracle_value(FieldOracle(values, field.origin, field.voxel_size), T, zero, intrinsics, mask)

        np.testing.assert_allclose(dense[at], difference(nudged), rtol=5e-3, atol=2e-3)


@pytest.mark.parametrize("view", VIEWS)
def test_gradients_are_those_of_the_march(view: str) -> None:
    m, T = random_map("blobs", 3), float32_pose(view)
    mask = f32(smooth_pixels(m, T))
    fast, slow = (gradient(theta_at(m), m, f32(T), mask, s) for s in (search, march))
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(slow), strict=True):
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-4, atol=1e-5)
    assert any(np.abs(np.asarray(leaf)).max() > 0 for leaf in jax.tree.leaves(fast))


@pytest.mark.parametrize("view", VIEWS)
def test_forward_mode_is_reverse_mode(view: str) -> None:
    m, T = random_map("blobs", 4), float32_pose(view)
    theta, mask = theta_at(m), f32(smooth_pixels(m, T))
    rng = np.random.default_rng(7)
    direction = jax.tree.map(lambda a: f32(rng.standard_normal(np.shape(a))), theta)
    hits = search_jit(m, *emission.world_rays(f32(T), Camera(CAMERA.width, CAMERA.height, *INTRINSICS)))
    forward = forward_gradient(theta, direction, m, f32(T), mask, hits)
    reverse = gradient(theta, m, f32(T), mask, search)
    products = jax.tree.map(lambda a, b: np.sum(np.asarray(a, float) * np.asarray(b, float)), reverse, direction)
    sizes = jax.tree.map(lambda a, b: np.sum(np.abs(np.asarray(a, float) * np.asarray(b, float))), reverse, direction)
    assert float(forward) == pytest.approx(sum(jax.tree.leaves(products)), abs=1e-4 * sum(jax.tree.leaves(sizes)))


def test_gradients_are_finite_at_singular_points() -> None:
    """Rays exactly along the planes between cubes, pixels without a hit, and a camera inside a solid."""
    cases = [
        (random_map("blobs", 1), camera_pose((ORIGIN[0] + VOXEL, ORIGIN[1] + 9 * VOXEL, ORIGIN[2] + 7 * VOXEL), 0.0)),
        (random_map("thin walls", 2), camera_pose((-0.5, 0.2, 1.0), 0.0)),
        (random_map("empty", 0), VIEWS["oblique"]),
        (random_map("solid", 0), VIEWS["oblique"]),
    ]
    ones = jnp.ones(len(WEIGHTS))
    for m, T in cases:
        for leaf in jax.tree.leaves(gradient(theta_at(m), m, f32(T), ones, search)):
            assert np.isfinite(np.asarray(leaf)).all()
