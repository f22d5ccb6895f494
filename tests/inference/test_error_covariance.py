"""Test how errors go through an estimate: laws of the covariance that a filter states."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from tests.helpers.analytic_room import Room, camera_pose
from tests.helpers.localisation_room import GRID, ROOM
from tests.inference import test_tracking
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference import linear_gaussian
from vssm_gym.inference.alignment import reference_view
from vssm_gym.inference.alignment.surface_error import Influence
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.linear_gaussian import Gaussian, LinearGaussian
from vssm_gym.inference.prism.filter import Prism
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.inference.tracking.error_covariance import ERRORS, Considered, estranged, nothing
from vssm_gym.inference.tracking.pose_update import Gain, gain, propagated
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import RIGID, GaussianBelief, RigidState


def covariance_of(rng: np.random.Generator, n: int, scale: float = 1.0) -> np.ndarray:
    root = rng.standard_normal((n, n + 4)) / np.sqrt(n)
    return scale * root @ root.T


def belief_of(P: np.ndarray) -> GaussianBelief:
    return GaussianBelief(RigidState(jnp.eye(4), jnp.zeros(6)), jnp.asarray(P, jnp.float32), RIGID)


def moving(H: np.ndarray, N: np.ndarray, G: np.ndarray | None = None) -> Influence:
    """Return errors of a gradient of curvature H: N independent, G by unit errors."""
    surfaces = np.zeros((ERRORS, len(H)))
    if G is not None:
        surfaces[: len(G)] = G
    return Influence(*(jnp.asarray(a, jnp.float32) for a in (H, N, surfaces)))


def gain_of(P: np.ndarray, H: np.ndarray) -> Gain:
    return gain(jnp.asarray(P[:6, :6], jnp.float32), jnp.ones(()), jnp.asarray(H, jnp.float32))


@pytest.mark.parametrize("seed", range(4))
def test_in_a_linear_gaussian_world_the_filter_is_the_kalman_filter(seed: int) -> None:
    """An image whose gradient errs by its curvature is an observation ``N(pose, H^-1)``: mean and covariance agree."""
    rng = np.random.default_rng(seed)
    P, H = covariance_of(rng, 12), covariance_of(rng, 6, 3.0)
    x = rng.standard_normal(6)  # what the image says of the pose's error
    moved = np.linalg.solve(H + np.linalg.inv(P[:6, :6]), H @ x)  # where the MAP search ends
    both, _ = propagated(nothing(12), belief_of(P), jnp.asarray(moved, jnp.float32), gain_of(P, H), moving(H, H))
    seen = LinearGaussian(jnp.eye(12)[:6], jnp.zeros(6), jnp.asarray(np.linalg.inv(H), jnp.float32))
    kalman = linear_gaussian.invert(Gaussian(jnp.zeros(12), jnp.asarray(P, jnp.float32)), seen)
    np.testing.assert_allclose(both.covariance, kalman.covariance, atol=5e-3)
    np.testing.assert_allclose(both.mean, kalman.A @ jnp.asarray(x, jnp.float32) + kalman.a, atol=5e-3)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("seen", [0, 1, 3, 5])
def test_a_direction_that_the_image_does_not_show_keeps_its_prior(seen: int, seed: int) -> None:
    """The marginal of pose coordinates without curvature is that of the prior, however wrong the surfaces are."""
    rng = np.random.default_rng(seed)
    root = np.zeros((6, max(seen, 1)))
    root[:seen] = rng.standard_normal((seen, max(seen, 1)))
    H = 100.0 * root @ root.T
    G = np.zeros((9, 6))
    G[:, :seen] = 20.0 * rng.standard_normal((9, seen))
    # The seen coordinates tell nothing of the others; velocities go with both.
    P = np.diag(rng.uniform(0.5, 2.0, 12))
    P[6:, 6:] += 0.2 * covariance_of(rng, 6)
    after, _ = propagated(nothing(12), belief_of(P), jnp.zeros(6), gain_of(P, H), moving(H, 0.3 * H, G))
    unseen = slice(seen, 6)
    got = np.asarray(after.covariance, float)
    np.testing.assert_allclose(got[unseen, unseen], P[unseen, unseen], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("std", [0.01, 0.1])
@pytest.mark.parametrize("seed", range(4))
def test_single_precision_keeps_the_prior_of_an_unseen_direction(seed: int, std: float) -> None:
    """An image from close up fixes three random directions to 0.3 mm, and says nothing of the others."""
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    H, P = 1e7 * axes[:, :3] @ axes[:, :3].T, std**2 * np.eye(12)
    after, _ = propagated(nothing(12), belief_of(P), jnp.zeros(6), gain_of(P, H), moving(H, H))
    got = axes.T @ np.asarray(after.covariance, float)[:6, :6] @ axes
    np.testing.assert_allclose(got[3:, 3:], std**2 * np.eye(3), atol=0.05 * std**2)
    assert np.linalg.eigvalsh(got).min() > 0.0
    assert np.diag(got)[:3].max() < 1e-5


@pytest.mark.parametrize("seed", range(2))
def test_covariances_are_those_of_simulated_errors(seed: int) -> None:
    """Simulate ``e``, ``u``, ``d`` and ``m`` in float64 over six steps; every covariance that is kept is theirs."""
    rng = np.random.default_rng(seed)
    n, p, m, samples, kept, share = 12, 6, 3, 60000, 0.8, 0.2
    P = covariance_of(rng, n)
    e = rng.multivariate_normal(np.zeros(n), P, samples)
    u, d, of_map = rng.standard_normal((samples, m)), np.zeros((samples, 6)), np.zeros((samples, 6))
    considered, belief = nothing(n), belief_of(P)
    for step in range(6):
        F = np.eye(n) + 0.2 * rng.standard_normal((n, n)) / np.sqrt(n)
        Q, H, N = covariance_of(rng, n, 0.1), covariance_of(rng, p), covariance_of(rng, p, 0.2)
        G = rng.standard_normal((m, p))
        K = np.linalg.inv(np.linalg.inv(P) + np.pad(H, ((0, n - p), (0, n - p))))[:, :p]
        A = np.eye(n) - np.pad(K @ H, ((0, 0), (0, n - p)))
        e = e @ F.T + rng.multivariate_normal(np.zeros(n), Q, samples)
        u = kept * u + np.sqrt(1 - kept**2) * rng.standard_normal((samples, m))
        e = e @ A.T + (u @ G + rng.multivariate_normal(np.zeros(p), N, samples)) @ K.T
        of_map = (1 - share) * of_map + share * (d + e[:, :p])
        f32 = [jnp.asarray(a, jnp.float32) for a in (F, Q, A, K)]
        predicted = f32[0] @ belief.covariance @ f32[0].T + f32[1]
        covariance, considered = considered.predict(f32[0], jnp.float32(kept)).correct(
            predicted, f32[2], f32[3], moving(H, N, G)
        )
        belief = GaussianBelief(belief.mean, covariance, RIGID)
        considered = considered.write(belief, jnp.float32(share))
        if step % 2:
            e[:, :p] += d - of_map
            d = of_map
            belief, considered = considered.renew(belief)
        P = np.asarray(belief.covariance, float)
    sampled = np.cov(np.concatenate([e, u, d + 1e-9 * rng.standard_normal(d.shape), of_map], axis=1).T)
    std = np.sqrt(np.diag(sampled))
    correlations = sampled / np.outer(std, std)
    ours = np.zeros_like(sampled)
    ours[:n, :n], ours[n : n + m, n : n + m], ours[n + m :, n + m :] = belief.covariance, np.eye(m), considered.frames
    ours[:n, n : n + m] = considered.state_surfaces[:, :m]
    ours[n + m :, :n] = considered.frames_state
    ours[n + m :, n : n + m] = considered.frames_surfaces[:, :m]
    ours[n : n + m, :n], ours[:n, n + m :] = ours[:n, n : n + m].T, ours[n + m :, :n].T
    ours[n : n + m, n + m :] = ours[n + m :, n : n + m].T
    np.testing.assert_allclose(ours / np.outer(std, std), correlations, atol=0.03)


def test_a_new_state_has_nothing_in_common_with_the_drift() -> None:
    frames = jnp.asarray(covariance_of(np.random.default_rng(0), 12), jnp.float32)
    one = Considered(frames, jnp.ones((12, 12)), jnp.ones((12, ERRORS)), jnp.ones((12, ERRORS)))
    other = estranged(one)
    np.testing.assert_array_equal(other.frames, jnp.tile(frames[6:, 6:], (2, 2)))
    assert not any(np.any(a) for a in (other.frames_state, other.state_surfaces, other.frames_surfaces))


@pytest.mark.parametrize("seed", range(3))
def test_neither_writing_nor_rendering_changes_the_belief_in_the_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    both = covariance_of(rng, 24, 0.01)
    belief = belief_of(both[12:, 12:])
    f32 = lambda a: jnp.asarray(a, jnp.float32)
    before = Considered(f32(both[:12, :12]), f32(both[:12, 12:]), jnp.zeros((12, ERRORS)), jnp.zeros((12, ERRORS)))
    world = np.asarray(before.in_world(belief).covariance)
    written = before.write(belief, jnp.float32(0.4))
    np.testing.assert_allclose(written.in_world(belief).covariance, world, atol=1e-6)
    against, renewed = written.renew(belief)
    np.testing.assert_allclose(renewed.in_world(against).covariance, world, atol=1e-6)
    assert np.abs(np.asarray(against.covariance) - np.asarray(belief.covariance)).max() > 1e-3


# In rooms


@dataclass(frozen=True)
class BareRoom(Room):
    """Describe a room whose walls have one colour."""

    def colour(self, p: np.ndarray) -> np.ndarray:
        """Return the same grey everywhere."""
        return np.full(np.shape(p), 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.0, 0.1, 0.25])
def test_a_camera_that_slides_along_a_bare_wall_stays_inside_its_region(speed: float) -> None:
    """Nothing shows the motion along the wall: two seconds at any speed of a hand lie in the 95 % region of it."""
    camera = Camera.from_hfov(64, 48, np.radians(60.0))
    room = BareRoom(((-3.0, -6.0, -4.0), (1.0, 6.0, 6.0)))
    pose = lambda k: camera_pose((0.0, 0.1 * speed * k, 1.0), 0.0)
    prism = Prism(Rig.of(camera))
    world = np.linalg.inv(pose(0))
    m = VoxelMap.prior((-3.2, -3.2, -3.2), 0.1, (64, 64, 64), slots=4096)
    start = at_rest(RIGID, jnp.eye(4), 1e-6 * jnp.eye(6), (0.5, 1.0))
    state = prism.init(Posterior(start, m), room.image(pose(0), camera), jax.random.key(0))
    for k in range(1, 21):
        image = room.image(pose(k), camera)
        state, info = prism.step(state, jnp.zeros(6), image, 0.1)
        assert info.status.accepted
        truth = RigidState(jnp.asarray(world @ pose(k), jnp.float32), jnp.zeros(6))
        off = np.asarray(RIGID.error(info.belief.mean, truth), float)
        P = np.asarray(info.belief.covariance, float)
        along = np.array([1, 0, 0, 0, 0, 0.0])  # of the image, to the right
        variance = along @ P[:6, :6] @ along
        assert (along @ off[:6]) ** 2 <= chi2.ppf(0.95, 1) * variance
    # Two seconds at an unknown velocity of 0.5 m/s, and a hand's accelerations on the way
    assert 1.0 < np.sqrt(variance) < 1.5


@pytest.mark.slow
def test_simulation_based_calibration_of_the_tracker() -> None:
    """Draw start, drive and the map's errors from the model: mean NEES / 3 is near 1, and poses lie in their regions.

    Every wall and every side of the furniture of the room is displaced in the map, by the std that is assumed. Walls of
    three to four metres are one piece, patches are of a metre: so much in common is more than is assumed, and the bars
    are half and 2.5 times the variance, and three quarters of the poses.
    """
    rng, found = np.random.default_rng(0), []
    std = reference_view.LEARNED * GRID[1]
    displaced = lambda corners: tuple(tuple(np.asarray(c) + std * rng.standard_normal(3)) for c in corners)
    for seed in range(16):
        m = Room(displaced(ROOM.interior), tuple(displaced(box) for box in ROOM.boxes)).to_map(*GRID)
        state = test_tracking.start(m=m)
        for command, planar in test_tracking.drive(30, 100 + seed):
            state, info = test_tracking.step(state, command, test_tracking.see(planar))
            if info.status.accepted:
                belief, truth = info.belief, jnp.asarray(planar, jnp.float32)
                off = np.asarray(belief.manifold.error(belief.mean, truth), float)
                found.append(off @ np.linalg.solve(np.asarray(belief.covariance, float), off))
    assert len(found) >= 0.95 * 16 * 30
    assert 0.5 < np.mean(found) / 3 < 2.5
    assert np.mean(np.array(found) <= chi2.ppf(0.95, 3)) >= 0.75
