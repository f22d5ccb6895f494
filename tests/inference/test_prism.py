"""Test the five steps of PRISM in a room known in closed form."""

import logging
from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from tests.helpers.prism_room import (
    CAMERA,
    CONFIG,
    DT,
    EXPECTED,
    EXTENT,
    ROOM,
    VOXEL,
    copy,
    error,
    image,
    prism_of,
    same_map,
    start,
    step,
    true_pose,
    walk,
    walked,
)
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_log
from vssm_gym.inference.alignment import surface_error
from vssm_gym.inference.alignment.exposure import expose
from vssm_gym.inference.alignment.surface_error import SurfaceErrorConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.prism.config import HAND, PrismConfig
from vssm_gym.inference.prism.filter import PrismState, _draw_poses
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking import camera_filter, process_noise
from vssm_gym.inference.tracking.camera_filter import Tracked, TrackingInput, at_rest
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.error_covariance import nothing
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import RIGID, Rigid, RigidNoise, Transition, rigid_belief

OK = Status.OK
RIG = Rig.of(CAMERA)

FRAMES = 12


# The pose


@pytest.mark.slow
@pytest.mark.parametrize("config", [CONFIG, EXPECTED], ids=["mean", "expectation"])
def test_a_smooth_walk_is_tracked(config: PrismConfig) -> None:
    """Over 27 cm and 13 degrees, in cells of 8 cm, every frame is within 1 cm and half a degree."""
    _, infos = walked(FRAMES, config)
    assert [info.status for info in infos] == [OK] * FRAMES
    off = np.array([error(info.belief, true_pose(k)) for k, info in enumerate(infos, 1)])
    assert off[:, 0].max() < 0.01
    assert off[:, 1].max() < 0.5


def test_covariances_are_symmetric_and_positive() -> None:
    for info in walked(FRAMES)[1]:
        covariance = np.asarray(info.belief.covariance, float)
        scale = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-5 * scale.max() * scale.min())
        assert np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > 1e-4
        assert (scale < 1.0).all()


def track(
    state: PrismState, k: float, control: jax.Array | None = None, transition: Transition = HAND, **past
) -> Tracked:
    """Track image ``k`` from the state's past, with some of its fields replaced."""
    before = replace(state.past, **past)
    control = jnp.zeros(6) if control is None else control
    given = TrackingInput(
        before, transition, control, jnp.float32(DT), state.reference, image(k), RIG, state.key, False
    )
    return camera_filter.track(given, CONFIG.tracking)


@pytest.mark.parametrize("seed", range(4))
def test_a_step_is_the_linear_gaussian_algebra(seed: int) -> None:
    """Compare steps 1, 3 and 4 in float64: ``e' = (1 - K H) e + K g`` of the whole state, ``K = (P^-1 + H)^-1``.

    Dense 12 x 12 algebra with neither a split nor a conditional in it.
    """
    state, _ = walked(FRAMES)
    prior = state.past.belief
    if seed:  # any correlations between pose and velocity, about as wide as the filter's
        root = np.random.default_rng(seed).standard_normal((12, 16)) / 4.0
        scale = np.repeat([0.01, 0.01, 0.2, 0.3], 3)
        prior = rigid_belief(prior.mean, jnp.asarray((root @ root.T) * np.outer(scale, scale), jnp.float32))
    tracked = track(state, FRAMES + 1, belief=prior, considered=nothing(12))
    scale = process_noise.scale(RIGID, state.past.noise_scale)
    predicted = HAND.predict(prior, jnp.zeros(6), jnp.float32(DT), scale)
    P = np.asarray(predicted.covariance, float)
    P_pose = np.linalg.inv(P[:6, :6])
    T_ref_cam = inverse(state.reference.T_world_cam) @ tracked.T_world_cam
    seen = expose(image(FRAMES + 1), tracked.gain)
    moving = surface_error.influence(
        T_ref_cam, jnp.eye(6), state.reference, seen, CAMERA, CONFIG.tracking.align, SurfaceErrorConfig()
    )
    H = np.zeros((12, 12))
    H[:6, :6] = moving.curvature
    K = np.linalg.inv(np.linalg.inv(P) + H)
    G = np.zeros((12, len(moving.surfaces)))
    G[:6] = np.asarray(moving.surfaces, float).T
    S = np.zeros((12, 12))
    S[:6, :6] = moving.noise
    A = np.eye(12) - K @ H
    covariance = A @ P @ A.T + K @ (G @ G.T + S) @ K.T
    scale = np.sqrt(np.diag(covariance))
    got = np.asarray(tracked.belief.covariance, float)
    np.testing.assert_allclose(got / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=1e-2)
    cross = np.asarray(tracked.considered.state_surfaces, float)
    np.testing.assert_allclose(cross / scale[:, None], K @ G / scale[:, None], atol=1e-2)
    # The mean: the regression of the predicted velocity error on the pose's, at the pose that was found.
    T_prior, T = predicted.mean.T_world_body, tracked.belief.mean.T_world_body
    moved = np.asarray(se3_log(inverse(T_prior) @ T), float)
    velocity = np.asarray(predicted.mean.velocity, float) + P[6:, :6] @ P_pose @ moved
    np.testing.assert_allclose(np.asarray(tracked.belief.mean.velocity, float), velocity, atol=2e-3 * scale[6:].max())


@pytest.mark.parametrize("axis", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])
def test_a_turn_that_nothing_predicts_is_tracked(axis: tuple[int, ...]) -> None:
    """The images alone turn the start: for a turn of 7 degrees one iteration at full resolution is enough.

    From the predicted pose, which knows nothing of the turn, one iteration leaves an error of degrees.
    """
    state, T = start(), true_pose(0)
    T[:3, :3] = T[:3, :3] @ np.asarray(jaxlie.SO3.exp(jnp.radians(7.0) * jnp.asarray(axis, float)).as_matrix())
    one = replace(CONFIG.tracking, align=replace(CONFIG.tracking.align, levels=(1,), iterations=(1,)))
    given = TrackingInput(
        state.past, HAND, jnp.zeros(6), jnp.float32(DT), state.reference, ROOM.image(T, CAMERA), RIG, state.key, False
    )
    tracked = camera_filter.track(given, one)
    metres, degrees = error(tracked.belief, T)
    assert bool(tracked.accepted)
    assert metres < 0.01
    assert degrees < 0.2


def test_an_uncertain_start_stays_uncertain_in_the_world() -> None:
    """Images show a camera where it is against its own map alone: what was unknown at the start stays unknown."""
    known = at_rest(RIGID, jnp.eye(4), 0.05**2 * jnp.eye(6), CONFIG.tracking.start_velocity)
    prior = Posterior(known, VoxelMap.cube((0.0, 0.0, 0.0), EXTENT, VOXEL))
    state = prism_of(CONFIG).init(prior, image(0), jax.random.key(0))
    for k in range(1, 4):
        state, info = step(state, image(k))
        stds = np.sqrt(np.diag(np.asarray(info.belief.covariance, float))[:6])
        assert stds[3:].min() > 0.045 and stds.max() < 0.1
        assert np.sqrt(np.diag(np.asarray(state.past.belief.covariance, float))[:6]).max() < 0.02


def test_an_overwhelming_prior_holds_the_pose() -> None:
    """In step 2 a prior more precise than all pixels keeps its mean, and a vague one gives the images' pose."""
    state, _ = walked(FRAMES)
    sure = np.diag(np.repeat([1e-7, 1e-7, 1e-9, 1e-9], 3)) ** 2
    still = Rigid(RigidNoise(1e-7, 1e-7, 1e-7, 1e-7))
    prior = rigid_belief(state.past.belief.mean, jnp.asarray(sure + 1e-14 * np.eye(12), jnp.float32))
    held = track(state, FRAMES, transition=still, belief=prior, noise_scale=process_noise.full())
    moved = inverse(held.predicted.mean.T_world_body) @ held.belief.mean.T_world_body
    assert np.abs(np.asarray(se3_log(moved))).max() < 1e-4
    assert error(held.predicted, true_pose(FRAMES))[0] > 0.01  # a step further on than the image


# The velocity


def test_velocity_is_within_its_deviation_on_a_path_of_constant_velocity() -> None:
    """The error is below 4 standard deviations, which fall below a tenth of the first ones."""
    v, w = np.array([0.17, 0.08, -0.05]), np.array([0.02, -0.05, 0.08])
    T_room_world = true_pose(0)

    def pose(k: int) -> np.ndarray:
        T = np.eye(4)
        T[:3, :3] = np.asarray(jaxlie.SO3.exp(jnp.asarray(w * k * DT)).as_matrix())
        T[:3, 3] = v * k * DT
        return T_room_world @ T

    state = start()
    for k in range(1, 15):
        state, info = step(state, ROOM.image(pose(k), CAMERA))
        assert info.status == OK
        if k >= 6:
            off = np.asarray(info.belief.mean.velocity, float) - np.concatenate([v, w])
            std = np.sqrt(np.diag(np.asarray(info.belief.covariance, float))[6:])
            assert (np.abs(off) < 4.0 * std).all()
            assert np.linalg.norm(off[:3]) < 0.06
            assert np.linalg.norm(off[3:]) < 0.06
    assert (std < [0.3] * 3 + [0.5] * 3).all()


def test_smooth_motion_narrows_the_prior_and_a_jerk_widens_it() -> None:
    state, _ = walked(FRAMES)
    assert (np.asarray(state.past.noise_scale) < 0.8).all()
    steady = track(state, FRAMES + 1)
    jerked = track(state, FRAMES + 4)
    assert (np.asarray(jerked.noise_scale) > np.asarray(steady.noise_scale)).all()
    doubtful = track(state, FRAMES + 1, noise_scale=process_noise.full())
    by = [np.sqrt(np.diag(np.asarray(t.belief.covariance, float))[6:]) for t in (steady, doubtful)]
    assert (by[0] < by[1]).all()
    # Both take the jerk, which the images show, for what it is.
    assert error(jerked.belief, true_pose(FRAMES + 4))[0] < 0.01


def test_a_known_acceleration_is_added() -> None:
    """The control changes the prediction as the transition does, and nothing else."""
    state, _ = walked(FRAMES)
    state_before = copy(state)
    control = jnp.asarray([0.1, -0.2, 0.05, 0.0, 0.1, 0.0])
    _, with_it = step(copy(state), image(FRAMES + 1), control=control)
    _, without = step(state, image(FRAMES + 1))
    assert with_it.status == without.status == OK
    change = np.asarray(with_it.belief.mean.velocity - without.belief.mean.velocity, float)
    along = change @ np.asarray(control, float) / np.linalg.norm(control)
    assert 0.0 < along < np.linalg.norm(control) * DT  # less: the image has its say
    predicted = track(state_before, FRAMES + 1, control).predicted.mean
    expected = HAND.mean(state_before.past.belief.mean, control, jnp.float32(DT))
    np.testing.assert_allclose(predicted.T_world_body, expected.T_world_body, atol=1e-6)
    np.testing.assert_allclose(predicted.velocity, expected.velocity, atol=1e-6)


# The map


def test_precision_never_falls() -> None:
    """This holds for every cell, in occupancy and colour, at every step; in some cell it rises."""
    first = start()
    before = [np.array(first.map.occupancy_precision), np.array(first.map.colour_precision)]
    for state, _ in walk(first, range(1, 6)):
        after = [np.array(state.map.occupancy_precision), np.array(state.map.colour_precision)]
        for old, new in zip(before, after, strict=True):
            assert (new >= old).all()
            assert (new > old).any()
        before = after


def test_the_map_renders_the_room() -> None:
    """From a pose between two frames half of the depths agree to 5 mm."""
    state, _ = walked(FRAMES)
    T_room_cam = true_pose(7.5)
    T = jnp.asarray(np.linalg.inv(true_pose(0)) @ T_room_cam, jnp.float32)
    seen = emission.render(state.map, T, CAMERA, CONFIG.update.max_depth)
    known = np.asarray(seen.known)
    off = np.abs(np.asarray(seen.depth, float) - ROOM.depth(T_room_cam, CAMERA))[known]
    assert known.mean() > 0.9
    assert np.median(off) < 0.005


def test_an_uncertain_pose_adds_less_precision_to_the_map() -> None:
    """In expectation over three poses, a wider belief adds less, and no cell gains more than at the
    mean alone."""
    state, _ = walked(FRAMES, EXPECTED)
    seen = image(FRAMES)
    gained = []
    for config, std in ((CONFIG, 0.0), (EXPECTED, 0.002), (EXPECTED, 0.02), (EXPECTED, 0.06)):
        covariance = state.past.belief.covariance.at[:6, :6].set(std**2 * jnp.eye(6))
        posterior = rigid_belief(state.past.belief.mean, covariance)
        m = jax.tree.map(jnp.copy, state.map)
        past = replace(state.past, belief=posterior)
        m = prism_of(config)._mapped(m, seen, past, jax.random.key(3))
        gained.append(
            float(np.sum(np.asarray(m.occupancy_precision, float) - np.asarray(state.map.occupancy_precision)))
        )
    assert gained == sorted(gained, reverse=True)
    assert gained[-1] < 0.9 * gained[0]


@pytest.mark.parametrize("samples", [3, 5, 9])
def test_samples_of_the_pose_have_its_mean_and_covariance(samples: int) -> None:
    """The mean is exact in every draw, the second moment over many draws."""
    state, _ = walked(FRAMES)
    std = jnp.asarray([0.02, 0.01, 0.03, 0.02, 0.04, 0.01])
    belief = state.past.belief
    belief = rigid_belief(belief.mean, belief.covariance.at[:6, :6].set(jnp.diag(std**2)))
    T_inverse = inverse(belief.mean.T_world_body)
    drawn = []
    for key in jax.random.split(jax.random.key(0), 300):
        poses = _draw_poses(belief, RIG, key, samples)
        assert poses.shape == (samples, 4, 4)
        drawn.append(np.asarray(jax.vmap(lambda T: se3_log(T_inverse @ T))(poses), float))
    errors = np.array(drawn) / np.asarray(std)
    np.testing.assert_allclose(errors.mean(axis=1), 0.0, atol=2e-3)
    second = np.einsum("dsi,dsj->ij", errors, errors) / errors[..., 0].size
    np.testing.assert_allclose(second, np.eye(6), atol=5.0 * np.sqrt(2.0 / (300 * (samples - 1) / 2)))


@pytest.mark.parametrize("samples", [0, 2, 4, -1])
def test_an_even_number_of_samples_is_refused(samples: int) -> None:
    with pytest.raises(InputError, match="odd"):
        PrismConfig(samples=samples)


@pytest.mark.parametrize("dt", [0.0, -0.1, float("nan"), float("inf")])
def test_time_must_pass(dt: float) -> None:
    with pytest.raises(InputError, match="dt"):
        step(walked(FRAMES)[0], image(FRAMES + 1), dt)


def test_the_reference_view_is_kept_until_the_camera_has_left_it() -> None:
    """Beyond the distance or the angle a new one is rendered at the pose of that image."""
    taken = 0
    for state, info in walk(start(), range(1, FRAMES + 1)):
        apart = np.asarray(se3_log(inverse(state.reference.T_world_cam) @ info.belief.mean.T_world_body))
        assert np.linalg.norm(apart[:3]) < CONFIG.reference_distance
        assert np.linalg.norm(apart[3:]) < CONFIG.reference_angle
        taken += bool((np.abs(apart) < 1e-6).all())
    assert 1 <= taken < FRAMES


def test_the_window_follows_a_camera_that_leaves_it() -> None:
    """Backwards through a cube of 2 m it moves by whole blocks, and dropped blocks before the camera are counted."""
    first = 26
    state = start(extent=1.92, first=image(first))
    block, moves, forgotten = 8 * 0.08, 0, 0
    for k in range(first - 1, -1, -1):
        edge = np.asarray(state.map.origin)
        state, info = step(state, image(k))
        assert info.status == OK
        middle = 0.5 * np.asarray(state.map.bounds).sum(axis=0)
        off = np.asarray(info.belief.mean.T_world_body)[:3, 3] - middle
        assert np.abs(off).max() <= CONFIG.window_margin * 3 * block + 1e-5
        shift = (np.asarray(state.map.origin) - edge) / block
        np.testing.assert_allclose(shift, np.round(shift), atol=1e-4)
        moved = bool(np.any(np.round(shift)))
        assert moved or info.left_window == 0
        moves, forgotten = moves + moved, forgotten + info.left_window
    assert moves >= 1
    assert forgotten > 0
    assert error(info.belief, true_pose(0), true_pose(first))[0] < 0.02


# Repeatability and cost


@pytest.mark.parametrize("solver", ["gauss_newton", "adam"])
def test_the_same_seed_gives_the_same_bytes(solver: str) -> None:
    """With the published solver, which draws pixels, another seed gives other bytes."""
    config = PrismConfig(tracking=TrackingConfig(solver=solver))
    ends = []
    for seed in (0, 0, 1):
        *_, (state, info) = walk(start(config, seed=seed), range(1, 3), config)
        assert info.status == OK
        assert error(info.belief, true_pose(2))[0] < 0.02
        ends.append(state)
    assert same_map(ends[0].map, ends[1].map)
    poses = [np.asarray(end.past.T_world_cam).tobytes() for end in ends]
    assert poses[0] == poses[1]
    assert (poses[0] == poses[2]) == (solver == "gauss_newton")


def test_nothing_is_compiled_between_steps(caplog: pytest.LogCaptureFixture) -> None:
    """New poses, gaps, reference views and windows are values, not shapes."""
    *_, (state, _) = walk(walked(FRAMES)[0], range(FRAMES + 1, FRAMES + 5))
    with caplog.at_level(logging.DEBUG), jax.log_compiles():
        for k in range(FRAMES + 5, FRAMES + 10):
            frame = image(k)
            caplog.clear()
            state, info = step(state, frame, DT + 0.001 * k)
            assert info.status == OK
            compiled = [record.getMessage() for record in caplog.records if "ompiling" in record.getMessage()]
            assert compiled == []
