"""Test the model: its joint density against a float64 oracle, ancestral rollouts and the regions they predict."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from tests.helpers.analytic_room import camera_pose
from tests.helpers.field_oracle import EMPTY, GUESSED, KNOWN, FieldOracle, pixel_log_prob
from tests.helpers.localisation_room import GRID, ROOM
from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot, execute
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission, predictive, spatial_model
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.spatial_model import SpatialModel
from vssm_gym.model.transition import (
    PLANAR,
    RIGID,
    MotionNoise,
    Planar,
    Rigid,
    RigidNoise,
    RigidState,
    planar_belief,
    rigid_belief,
)

ROBOT, LOW = HolonomicRobot(), NOISE_LEVELS["low"]
VIEW = Camera.from_hfov(20, 15, np.radians(70))
DT, STEPS = 0.2, 15  # s: 3 s in all
FUTURES, TRIALS = 500, 200
COVERAGE = (0.90, 0.99)  # what a 95 % region may hold of the truth


def f32(a) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def planar_model(m: VoxelMap, slip: tuple[float, float, float] = (0.004, 0.004, 0.002)) -> SpatialModel:
    return SpatialModel(Planar(MotionNoise(LOW.turn, LOW.step), slip), m, VIEW, f32(ROBOT.T_body_cam))


@pytest.fixture(scope="module")
def room() -> VoxelMap:
    return ROOM.to_map(*GRID)


def commands(rng: np.random.Generator, steps: int = STEPS) -> np.ndarray:
    """Draw commands: turn and drive within the limits, sometimes only one of the two."""
    u = rng.uniform([-1.0, -1.0, 0.0], 1.0, (steps, 3)) * ROBOT.limits
    u[rng.random(steps) < 0.15, 0] = 0.0
    u[rng.random(steps) < 0.15, 2] = 0.0
    return u


def random_belief(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of a robot known to a few centimetres and degrees, correlated."""
    root = np.diag([0.03, 0.03, 0.03]) @ rng.normal(size=(3, 3)) / np.sqrt(3)
    return np.array([*rng.uniform(-1, 1, 2), rng.uniform(-3, 3)]), root @ root.T


# --- joint density


def oracle_images(m: VoxelMap, poses: list[np.ndarray], images: RGBD, scales: EmissionScales) -> list[float]:
    """Return ``sum log p(x | z, M)`` over all pixels, in float64; every image has a reading at every pixel."""
    assert bool(images.hit.all())
    oracle, total = FieldOracle.of(m), []
    for t, T in enumerate(poses):
        depth, rgb, k = oracle.render(T, VIEW)
        known = np.asarray(emission.render(m, f32(T), VIEW).known).reshape(-1)
        seen = np.asarray(images.depth[t], float).reshape(-1), np.asarray(images.rgb[t], float).reshape(-1, 3)
        kind = np.where(k > 0, np.where(known, KNOWN, GUESSED), EMPTY)
        total.append(pixel_log_prob(*seen, depth, rgb, kind, scales).sum())
    return total


def test_the_joint_density_is_the_sum_of_its_terms_in_float64(room: VoxelMap) -> None:
    """Four steps of a rigid camera: cells, start, transitions and images, each against SciPy."""
    rng = np.random.default_rng(0)
    noise, scales = RigidNoise(0.3, 0.05, 0.2, 0.05), EmissionScales(depth=0.05, rgb=0.02)
    spatial = SpatialModel(Rigid(noise), VoxelMap.prior(*GRID), VIEW, jnp.eye(4), scales)
    starts = camera_pose((-1.0, 0.0, 1.0), 0.1)
    controls, velocity = rng.normal(size=(3, 6)) * 0.3, rng.normal(size=6) * 0.1
    poses, velocities = [starts], [velocity]
    for u in controls:
        velocities.append(velocities[-1] + u * DT + rng.normal(size=6) * 0.1)
        poses.append(poses[-1] @ np.asarray(se3_exp(f32(rng.normal(size=6) * 0.05)), float))
    images = [ROOM.image(T, VIEW) for T in poses]
    images = jax.tree.map(lambda *a: jnp.stack(a), *images)
    states = RigidState(f32(np.stack(poses)), f32(np.stack(velocities)))
    spread = np.diag(rng.uniform(0.1, 0.3, 12) ** 2)
    start = rigid_belief(RigidState(f32(starts), jnp.zeros(6)), f32(spread))
    terms = spatial_model.log_joint(spatial, start, states, f32(controls), images, room, DT)

    cells = stats.norm.logpdf(np.asarray(room.occupancy, float), -0.001, 10.0).sum()
    cells += stats.norm.logpdf(np.asarray(room.colour, float), 0.0, 10.0).sum()
    np.testing.assert_allclose(float(terms.cells), cells, rtol=1e-6)
    z1 = stats.multivariate_normal.logpdf(np.r_[np.zeros(6), velocity], np.zeros(12), spread)
    np.testing.assert_allclose(float(terms.start), z1, rtol=1e-4)
    for t in range(3):
        dv = velocities[t + 1] - velocities[t] - controls[t] * DT
        R = Rotation.from_rotvec(velocities[t + 1][3:] * DT).as_matrix() @ poses[t][:3, :3]
        turned = Rotation.from_matrix(R.T @ poses[t + 1][:3, :3]).as_rotvec()
        moved = R.T @ (poses[t + 1][:3, 3] - poses[t][:3, 3] - velocities[t + 1][:3] * DT)
        a = np.linalg.norm(turned)
        V = np.eye(3) + (1 - np.cos(a)) / a**2 * np.cross(np.eye(3), -turned)
        V += (a - np.sin(a)) / a**3 * (np.outer(turned, turned) - a**2 * np.eye(3))
        xi = np.r_[np.linalg.solve(V, moved), turned, dv]
        stds = np.repeat([0.05, 0.05, 0.3, 0.2], 3) * np.sqrt(2.0)
        expected = stats.norm.logpdf(xi, 0.0, stds).sum() - 2.0 * np.log(2 * (1 - np.cos(a)) / a**2)
        np.testing.assert_allclose(float(terms.transitions[t]), expected, rtol=1e-3, atol=2e-3)
    np.testing.assert_allclose(np.asarray(terms.images), oracle_images(room, poses, images, scales), rtol=2e-3)
    parts = float(terms.cells) + float(terms.start) + float(terms.transitions.sum()) + float(terms.images.sum())
    np.testing.assert_allclose(float(terms.total), parts, rtol=1e-6)


@pytest.mark.slow  # the renderer's gradient inside a loop takes long to compile
def test_the_density_is_larger_at_the_truth_and_its_gradient_points_there(room: VoxelMap) -> None:
    """A displaced pose lowers the images' term, whose gradient points back."""
    spatial = planar_model(room)
    path = np.array([[-1.0, 0.0, 0.0], [-0.95, 0.0, 0.05], [-0.9, 0.0, 0.1]])
    cameras = [np.asarray(PLANAR.pose(f32(p)), float) @ ROBOT.T_body_cam for p in path]
    images = jax.tree.map(lambda *a: jnp.stack(a), *[ROOM.image(T, VIEW) for T in cameras])
    start, controls = planar_belief(f32(path[0]), jnp.eye(3) * 1e-2), jnp.full((2, 3), 0.05)

    @eqx.filter_jit
    def images_term(states):
        return spatial_model.log_joint(spatial, start, states, controls, images, room, DT).images.sum()

    away = f32(path).at[1, 0].add(0.04)
    assert float(images_term(f32(path))) > float(images_term(away))
    assert float(jax.grad(images_term)(away)[1, 0]) < 0.0


# --- rollouts


def test_rollouts_from_a_known_start_without_noise_are_the_motion(room: VoxelMap) -> None:
    still = SpatialModel(Planar(MotionNoise(0.0, 0.0), (0.0, 0.0, 0.0)), room, VIEW, f32(ROBOT.T_body_cam))
    u, start = commands(np.random.default_rng(1)), np.array([0.2, -0.3, 1.0])
    belief = planar_belief(f32(start), jnp.zeros((3, 3)))
    futures = spatial_model.rollout(jax.random.key(0), still, belief, f32(u), DT, samples=3)
    assert futures.images is None
    for t in range(STEPS):
        start = execute(start, u[t], NOISE_LEVELS["none"], np.random.default_rng(0))
        error = np.asarray(futures.states[:, t], float) - start
        error[:, 2] = np.angle(np.exp(1j * error[:, 2]))
        np.testing.assert_allclose(error, 0.0, atol=1e-5)


def test_rollouts_agree_with_the_environments_robot(room: VoxelMap) -> None:
    """After every step mean and covariance of 4000 futures equal those of 4000 runs of the simulator's robot."""
    rng, n = np.random.default_rng(2), 4000
    u, (mean, covariance) = commands(rng, 6), random_belief(rng)
    spatial = planar_model(room, (0.0, 0.0, 0.0))
    belief = planar_belief(f32(mean), f32(covariance))
    futures = spatial_model.rollout(jax.random.key(1), spatial, belief, f32(u), DT, samples=n).states
    runs = np.asarray(PLANAR.perturb(f32(mean), f32(rng.multivariate_normal(np.zeros(3), covariance, n))), float)
    for t in range(6):
        runs = np.stack([execute(run, u[t], LOW, rng) for run in runs])
        both = [np.asarray(PLANAR.error(futures[0, t], f32(s)), float) for s in (futures[:, t], runs)]
        scale = both[1].std(axis=0)
        np.testing.assert_allclose(both[0].mean(axis=0) / scale, both[1].mean(axis=0) / scale, atol=0.08)
        a, b = (np.cov((x / scale).T) for x in both)
        np.testing.assert_allclose(a, b, atol=0.1)


@pytest.mark.parametrize("which", ["mean map", "sampled maps"])
def test_imagined_images_are_those_of_the_futures(room: VoxelMap, which: str) -> None:
    """Each is rendered at its future's own pose; with sampled maps they differ by the map's uncertainty."""
    spatial = planar_model(room)
    belief = planar_belief(f32([-1.0, 0.0, 0.0]), jnp.eye(3) * 1e-4)
    u = f32(commands(np.random.default_rng(3), 2))
    futures = spatial_model.rollout(jax.random.key(2), spatial, belief, u, DT, samples=3, images=which)
    assert futures.images.depth.shape == (3, 2, VIEW.height, VIEW.width)
    assert futures.images.rgb.shape == (3, 2, VIEW.height, VIEW.width, 3)
    plain = spatial_model.rollout(jax.random.key(2), spatial, belief, u, DT, samples=3).states
    np.testing.assert_array_equal(np.asarray(plain), np.asarray(futures.states))
    expected = spatial.image(room, futures.states[2, 1])
    difference = np.abs(np.asarray(futures.images.depth[2, 1] - expected.depth))
    if which == "mean map":
        assert difference.max() < 1e-4
    else:  # ten measurements with std 3 cm, averaged over eight cells
        assert 1e-3 < np.median(difference) < 0.01


def test_rollouts_are_repeatable(room: VoxelMap) -> None:
    spatial, u = planar_model(room), f32(commands(np.random.default_rng(4)))
    belief = planar_belief(jnp.zeros(3), jnp.eye(3) * 1e-4)
    draw = lambda seed: np.asarray(
        spatial_model.rollout(jax.random.key(seed), spatial, belief, u, DT, samples=10).states
    )
    np.testing.assert_array_equal(draw(0), draw(0))
    assert (draw(0) != draw(1)).all()


# --- posterior predictive


def test_envelopes_are_the_moments_of_a_gaussian() -> None:
    """States drawn from a known Gaussian give its mean and covariance, and the chi-square quantile as radius."""
    rng = np.random.default_rng(5)
    T = Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix()
    mean = RigidState(jnp.eye(4).at[:3, :3].set(f32(T)), f32(rng.normal(size=6)))
    root = rng.normal(size=(12, 12)) * 0.03 + np.eye(12) * 0.05
    states = RIGID.perturb(mean, f32(rng.standard_normal((20_000, 12)) @ root.T))
    states = jax.tree.map(lambda a: a[:, None], states)
    region = predictive.envelope(RIGID, states)
    truth, scale = root @ root.T, np.sqrt(np.diag(root @ root.T))
    np.testing.assert_allclose(np.asarray(RIGID.error(mean, region.mean))[0] / scale, 0.0, atol=0.05)
    np.testing.assert_allclose(
        np.asarray(region.covariance[0]) / np.outer(scale, scale), truth / np.outer(scale, scale), atol=0.05
    )
    np.testing.assert_allclose(float(region.radius2[0]), stats.chi2.ppf(0.95, 12), rtol=0.03)
    assert abs(float(predictive.inside(RIGID, region, states).mean()) - 0.95) < 0.003


def test_regions_from_few_samples_keep_their_coverage() -> None:
    """With 40 samples of twelve coordinates new draws still lie inside 95 % of the time, not 60 %."""
    rng, held = np.random.default_rng(6), []
    start = RigidState(jnp.eye(4), jnp.zeros(6))
    for _ in range(60):
        states = RIGID.perturb(start, f32(rng.normal(size=(140, 12)) * 0.1))
        states = jax.tree.map(lambda a: a[:, None], states)
        few, many = (jax.tree.map(lambda a, s=s: a[s], states) for s in (slice(40), slice(40, None)))
        held.append(float(predictive.inside(RIGID, predictive.envelope(RIGID, few), many).mean()))
    assert 0.92 < np.mean(held) < 0.98


def test_a_region_without_volume_holds_its_samples() -> None:
    """All futures of a standing robot without slip are equal, and nothing is NaN."""
    states = jnp.broadcast_to(f32([1.0, 2.0, 0.5]), (50, 3, 3))
    region = predictive.envelope(PLANAR, states)
    assert np.isfinite(np.asarray(region.covariance)).all()
    assert bool(predictive.inside(PLANAR, region, states[0]).all())
    assert not bool(predictive.inside(PLANAR, region, states[0] + 0.01).any())


def test_image_summaries_by_hand() -> None:
    """Three futures of one pixel: two see a surface, at 1 and 2 m; the noise adds 2 * 0.1^2 and 2 * 0.01^2."""
    pixel = lambda d, c: RGBD(f32([[d]]), jnp.full((1, 1, 3), c), jnp.array([[d > 0]]), jnp.array([[d > 1.5]]))
    stack = lambda *images: jax.tree.map(lambda *a: jnp.stack(a), *images)
    scales = EmissionScales(depth=0.1, growth=0.0, rgb=0.01 * np.sqrt(2.0), textured=0.0)
    summary = predictive.image_summary(stack(pixel(1.0, 0.2), pixel(2.0, 0.4), pixel(0.0, 0.0)), scales)
    np.testing.assert_allclose(float(summary.depth_mean[0, 0]), 1.5, rtol=1e-6)
    np.testing.assert_allclose(float(summary.depth_variance[0, 0]), 0.5 + 0.02, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(summary.rgb_mean[0, 0]), 0.3, rtol=1e-6)
    np.testing.assert_allclose(np.asarray(summary.rgb_variance[0, 0]), 0.02 + 2e-4, rtol=1e-5)
    np.testing.assert_allclose(float(summary.hit_share[0, 0]), 2 / 3, rtol=1e-6)
    np.testing.assert_allclose(float(summary.known_share[0, 0]), 1 / 3, rtol=1e-6)
    nothing = predictive.image_summary(stack(pixel(0.0, 0.0), pixel(0.0, 0.0)), scales)
    assert np.isinf(float(nothing.depth_variance[0, 0]))
    assert float(nothing.depth_mean[0, 0]) == 0.0


# --- calibration of the future


@pytest.mark.slow
def test_the_true_planar_future_lies_in_its_region(room: VoxelMap) -> None:
    """200 beliefs and command sequences of 3 s, executed by the simulator's robot from a drawn start."""
    rng, spatial, held = np.random.default_rng(7), planar_model(room), []
    for trial in range(TRIALS):
        (mean, covariance), u = random_belief(rng), commands(rng)
        futures = spatial_model.rollout(
            jax.random.key(trial), spatial, planar_belief(f32(mean), f32(covariance)), f32(u), DT, samples=FUTURES
        )
        region = predictive.envelope(PLANAR, futures.states)
        truth = np.asarray(PLANAR.perturb(f32(mean), f32(rng.multivariate_normal(np.zeros(3), covariance))), float)
        path = []
        for command in u:
            truth = execute(truth, command, LOW, rng)
            path.append(truth)
        held.append(np.asarray(predictive.inside(PLANAR, region, f32(np.stack(path)))))
    at_end, at_any = np.mean(held, axis=0)[-1], np.mean(held)
    assert COVERAGE[0] <= at_end <= COVERAGE[1]
    assert COVERAGE[0] <= at_any <= COVERAGE[1]


@pytest.mark.slow
def test_the_true_rigid_future_lies_in_its_region(room: VoxelMap) -> None:
    """200 trajectories of 3 s in space, simulated in float64 by SciPy's rotations with the law of the rigid body."""
    rng, held = np.random.default_rng(8), []
    noise = RigidNoise(0.1, 0.01, 0.1, 0.01)
    spatial = SpatialModel(Rigid(noise), room, VIEW, jnp.eye(4))
    stds = np.repeat([0.01, 0.01, 0.1, 0.1], 3) * np.sqrt(2.0)
    spread = np.repeat([0.02, 0.02, 0.1, 0.1], 3)
    for trial in range(TRIALS):
        R, t = Rotation.random(random_state=trial).as_matrix(), rng.normal(size=3)
        velocity, u = rng.normal(size=6) * [0.5, 0.5, 0.5, 0.8, 0.8, 0.8], rng.normal(size=(STEPS, 6)) * 0.5
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, t
        belief = rigid_belief(RigidState(f32(T), f32(velocity)), f32(np.diag(spread**2)))
        futures = spatial_model.rollout(jax.random.key(trial), spatial, belief, f32(u), DT, samples=FUTURES)
        region = predictive.envelope(RIGID, futures.states, coordinates=6)
        start = RIGID.perturb(belief.mean, f32(rng.normal(size=12) * spread))
        T, velocity, path = np.asarray(start.T_world_body, float), np.asarray(start.velocity, float), []
        for control in u:
            e = rng.normal(size=12) * stds
            velocity = velocity + control * DT + e[6:]
            T = T.copy()
            T[:3, 3] += velocity[:3] * DT
            T[:3, :3] = Rotation.from_rotvec(velocity[3:] * DT).as_matrix() @ T[:3, :3]
            T = T @ np.asarray(se3_exp(f32(e[:6])), float)
            path.append(T)
        states = RigidState(f32(np.stack(path)), jnp.zeros((STEPS, 6)))
        held.append(np.asarray(predictive.inside(RIGID, region, states)))
    at_end, at_any = np.mean(held, axis=0)[-1], np.mean(held)
    assert COVERAGE[0] <= at_end <= COVERAGE[1]
    assert COVERAGE[0] <= at_any <= COVERAGE[1]
