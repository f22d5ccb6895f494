"""Test the baseline trackers, published Adam and emission-based, in the room of the default tracker's tests."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.inference.test_tracking import ELSEWHERE, MOTION, RIG, ROBOT, drive, error, see, start, step
from vssm_gym.inference.registry import FILTERS
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking import emission_tracking
from vssm_gym.inference.tracking.camera_filter import camera_pose
from vssm_gym.inference.tracking.emission_tracking import EmissionTracker, EmissionTrackerConfig
from vssm_gym.model.emission import RGBD

TRACKERS = {name: FILTERS[name].make(RIG, MOTION) for name in ("adam", "emission")}
each = pytest.mark.parametrize("name", TRACKERS)


@pytest.mark.slow
@each
def test_the_robot_is_tracked_in_its_map(name: str) -> None:
    tracker = TRACKERS[name]
    state, offs = start(tracker), []
    for command, planar in drive(12, 0):
        state, info = step(state, command, see(planar), tracker)
        assert info.status is Status.OK
        off, turned = error(state, planar)
        offs.append(off)
        assert turned < np.radians(0.5)
    assert np.sqrt(np.mean(np.square(offs))) < 0.005


@each
@pytest.mark.parametrize("kind", ["another place", "no depth"])
def test_images_that_do_not_fit_are_rejected(name: str, kind: str) -> None:
    command = drive(1, 5)[0][0]
    blind = RGBD.from_camera(np.full((48, 64, 3), 128, np.uint8), np.zeros((48, 64), np.float32))
    bad = {"another place": see(ELSEWHERE), "no depth": blind}[kind]
    tracker = TRACKERS[name]
    state, info = step(start(tracker), command, bad, tracker)
    assert info.status is Status.LOST
    assert state.lost
    predicted = MOTION.predict(start(tracker).past.belief, jnp.asarray(command, jnp.float32), ROBOT.dt)
    np.testing.assert_allclose(np.asarray(info.belief.mean), np.asarray(predicted.mean), atol=1e-6)


def test_the_camera_stays_at_its_height() -> None:
    """The search moves along the body's planar twists only."""
    tracker = EmissionTracker(RIG, MOTION)
    state = start(tracker)
    predicted = MOTION.predict(state.past.belief, jnp.array([0.1, 0.0, 0.05]), ROBOT.dt)
    T = camera_pose(predicted, RIG)
    image = see(np.asarray(predicted.mean, float) + np.array([0.02, -0.01, 0.02]))
    found = emission_tracking._descend(predicted, image, state.map, RIG, jax.random.key(0), EmissionTrackerConfig())
    np.testing.assert_allclose(float(found[2, 3]), float(T[2, 3]), atol=1e-5)
    assert float(jnp.abs(found - T).max()) > 5e-3


def test_steps_are_deterministic() -> None:
    command, planar = drive(1, 9)[0]
    tracker = TRACKERS["emission"]
    a, b = (step(start(tracker), command, see(planar), tracker)[1].belief.mean for _ in range(2))
    np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
