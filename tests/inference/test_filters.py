"""Test the contract of filters: every filter with every transition that it takes, in one room."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.dynamics.transitions import noisy_transition
from tests.helpers.localisation_room import CAMERA, GRID, ROOM, known_map
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import planar_to_matrix, se3_log
from vssm_gym.inference.filter import Filter, Rig
from vssm_gym.inference.registry import FILTERS, filters_for
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import (
    Bicycle,
    Imu,
    ImuNoise,
    MotionNoise,
    Planar,
    Rigid,
    RigidNoise,
    RigidState,
    Transition,
)
from vssm_gym.model.transition.with_rest import RestState

DT, HEIGHT = 0.2, 0.4  # s, m of the camera above the floor
T_BODY_CAM = planar_to_matrix(np.array([0.03, -0.01, 0.1])) @ np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, HEIGHT], [0.0, 0.0, 0.0, 1.0]]
)
RIG = Rig.of(CAMERA, T_BODY_CAM)
START = np.array([-0.5, -0.4, 2.9])
TURN, STEP = 0.18, 0.06  # rad and m of every step: a circle of a third of a metre
STEPS = 6
DARK = RGBD.from_camera(np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8), np.zeros((CAMERA.height, CAMERA.width)))

SPEED, RATE = STEP / DT, TURN / DT
TRANSITIONS: dict[str, Transition] = {
    "planar": Planar(MotionNoise(0.05, 0.02)),
    "bicycle": Bicycle(wheelbase=0.26),
    "rigid": Rigid(RigidNoise(0.15, 0.02, 0.3, 0.02)),
    "imu": Imu(ImuNoise(0.02, 0.01, 0.05, 0.05)),
    "learned imu": noisy_transition(Imu(), (0.02, 0.01, 0.05, 0.05), 15),
    "learned planar": noisy_transition(Planar(MotionNoise(0.05, 0.02)), (0.02, 0.05), 3),
}
# Every transition with PRISM and by dead reckoning, every other filter with the planar one and one more: a pair is
# compiled anew, and what a filter does depends on whether the state holds more than a pose, not on its noise.
OTHERS = {"tracker": "imu", "adam": "rigid", "frames": "bicycle", "emission": "bicycle"}
PAIRS = [
    (name, kind)
    for kind, transition in TRANSITIONS.items()
    for name in filters_for(transition)
    if kind in ("planar", OTHERS.get(name, kind))
]
every = pytest.mark.parametrize(("name", "kind"), PAIRS)


def pose(k: float) -> np.ndarray:
    """Return ``T_world_body`` after ``k`` steps of the arc."""
    radius, heading = STEP / TURN, START[2] + TURN * k
    centre = START[:2] + radius * np.array([-np.sin(START[2]), np.cos(START[2])])
    xy = centre + radius * np.array([np.sin(heading), -np.cos(heading)])
    return planar_to_matrix(np.array([*xy, heading]))


def see(k: float) -> RGBD:
    image = ROOM.image(pose(k) @ T_BODY_CAM, CAMERA)
    return RGBD.from_camera(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), np.asarray(image.depth))


def control(kind: str, k: int) -> jax.Array:
    """Return the control from ``k`` to ``k + 1``."""
    kind = kind.removeprefix("learned ")
    if kind == "planar":  # the chord of the arc
        return jnp.array([TURN, 0.5 * TURN, STEP * np.sinc(0.5 * TURN / np.pi)])
    if kind == "bicycle":
        return jnp.array([SPEED, np.arctan(0.26 * TURN / STEP)])
    centripetal = SPEED * RATE
    if kind == "imu":  # specific force and rate in the body's frame
        return jnp.array([0.0, centripetal, 9.81, 0.0, 0.0, RATE])
    heading = START[2] + TURN * (k + 0.5)
    return jnp.array([-centripetal * np.sin(heading), centripetal * np.cos(heading), 0.0, 0.0, 0.0, 0.0])


def make(name: str, kind: str) -> tuple[Filter, Posterior]:
    return made(name, TRANSITIONS[kind])


def made(name: str, transition: Transition) -> tuple[Filter, Posterior]:
    """Return the filter, and a prior at the start of the arc."""
    entry = FILTERS[name]
    manifold = transition.manifold
    p = manifold.twists.shape[1]
    start = at_rest(manifold, jnp.asarray(pose(0), jnp.float32), 1e-6 * jnp.eye(p), (0.05, 0.05))
    body = start.mean.body if isinstance(start.mean, RestState) else start.mean
    if isinstance(body, RigidState):  # it moves already
        direction = jnp.array([np.cos(START[2]), np.sin(START[2]), 0.0])
        moving = RigidState(body.T_world_body, jnp.concatenate([SPEED * direction, jnp.array([0.0, 0.0, RATE])]))
        mean = RestState(moving, start.mean.rest) if isinstance(start.mean, RestState) else moving
        start = type(start)(mean, start.covariance, manifold)
    m = known_map() if entry.needs_map else VoxelMap.prior(*GRID)
    return entry.make(RIG, transition), Posterior(start, m)


def off(belief, k: float) -> tuple[float, float]:
    """Return metres and radians between a belief's mean and the truth."""
    T = belief.manifold.pose(belief.mean)
    xi = np.asarray(se3_log(jnp.asarray(np.linalg.inv(pose(k)), jnp.float32) @ T), float)
    return float(np.linalg.norm(xi[:3])), float(np.linalg.norm(xi[3:]))


@pytest.mark.slow
@every
def test_a_body_is_followed(name: str, kind: str) -> None:
    """Assert as :func:`follow` does, with twice the error for Euler steps along an arc without correction by images."""
    allowed = 2.0 if FILTERS[name].blind and kind == "rigid" else 1.0
    follow(name, TRANSITIONS[kind], lambda k: control(kind, k), allowed)


def follow(name: str, transition: Transition, control_at: Callable[[int], jax.Array], allowed: float = 1.0) -> None:
    """Assert a pose within 2 cm and 2 degrees of the arc after six steps, and a belief that is a density."""
    tracker, prior = made(name, transition)
    assert tracker.transition is transition
    state = tracker.init(prior, see(0), jax.random.key(0))
    for k in range(STEPS):
        state, info = tracker.step(state, control_at(k), see(k + 1), DT)
        assert info.status is Status.OK, f"step {k}: {info.status.message}"
    metres, radians = off(info.belief, STEPS)
    assert metres < 0.02 * allowed
    assert radians < np.radians(2.0) * allowed
    covariance = np.asarray(info.belief.covariance, float)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-3, atol=1e-8)
    posterior = tracker.posterior(state)
    assert (posterior.map is not None) == (FILTERS[name].maps or FILTERS[name].needs_map)
    drawn = posterior.belief.sample(jax.random.key(1), 64)
    log_q = np.asarray(posterior.belief.log_prob(drawn), float)
    assert np.isfinite(log_q).all()
    n = len(transition.manifold.turns)
    # E[-log q] of a Gaussian: its entropy, up to the curvature of small turns and 64 draws
    assert abs(-log_q.mean() - float(posterior.belief.entropy())) < 5.0 * np.sqrt(0.5 * n / 64) + 0.05


@every
def test_darkness_is_reported_and_changes_no_map(name: str, kind: str) -> None:
    """Two images without a reading narrow no belief and change no map, and the next image is accepted."""
    tracker, prior = make(name, kind)
    state = tracker.init(prior, see(0), jax.random.key(0))
    state, before = tracker.step(state, control(kind, 0), see(1), DT)
    m = tracker.posterior(state).map
    precision = None if m is None else np.asarray(m.occupancy_precision).sum()
    spread = float(jnp.trace(before.belief.covariance[:2, :2]))
    for k in (1, 2):
        state, info = tracker.step(state, control(kind, k), DARK, DT)
        if FILTERS[name].blind:
            assert info.status is Status.OK
        else:
            assert info.status in (Status.LOST, Status.NO_READING)
            assert not info.status.accepted
        assert float(jnp.trace(info.belief.covariance[:2, :2])) > spread
    if precision is not None:
        assert np.asarray(tracker.posterior(state).map.occupancy_precision).sum() == precision
    if name == "frames":
        return  # the image before is dark: there is nothing to align to, now or ever
    # Commands lead on through the dark; whoever has none is believed to stay, and is found where it was.
    seen = 4 if TRANSITIONS[kind].commanded or FILTERS[name].blind else 1
    again = eqx.tree_at(lambda i: i.depth, see(seen), 1.0001 * see(seen).depth)  # another image of the place
    state, info = tracker.step(state, control(kind, 3), again, DT)
    assert info.status.accepted
    assert off(info.belief, seen)[0] < 0.03


@every
@pytest.mark.parametrize("dt", [0.0, -1.0, float("nan"), float("inf")])
def test_time_must_pass(name: str, kind: str, dt: float) -> None:
    tracker, prior = make(name, kind)
    state = tracker.init(prior, see(0), jax.random.key(0))
    with pytest.raises(InputError, match="dt"):
        tracker.step(state, control(kind, 0), see(1), dt)


@pytest.mark.parametrize("name", FILTERS)
def test_a_control_of_another_transition_is_refused(name: str) -> None:
    tracker, prior = make(name, "planar")
    state = tracker.init(prior, see(0), jax.random.key(0))
    with pytest.raises(InputError, match="control: expected the 3 numbers of Planar's controls"):
        tracker.step(state, jnp.zeros(4), see(1), DT)


@pytest.mark.parametrize("name", [name for name, entry in FILTERS.items() if entry.needs_map or entry.maps])
def test_a_filter_without_its_map_is_refused(name: str) -> None:
    tracker, prior = make(name, "planar")
    with pytest.raises(InputError, match="map"):
        tracker.init(Posterior(prior.belief, None), see(0), jax.random.key(0))


@pytest.mark.parametrize("name", [name for name, entry in FILTERS.items() if not entry.any_state])
def test_a_filter_refuses_a_transition_that_it_does_not_take(name: str) -> None:
    assert name not in filters_for(TRANSITIONS["rigid"])
    with pytest.raises(InputError, match="whose state is a pose"):
        tracker = FILTERS[name].make(RIG, TRANSITIONS["rigid"])
        tracker.init(make("tracker", "rigid")[1], see(0), jax.random.key(0))
