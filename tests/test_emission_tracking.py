"""The trackers that are compared: published Adam and emission-based, in the room of the default tracker's tests."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from test_tracking import ELSEWHERE, MAP, NOISE, RIG, drive, error, see, start

from vssm_gym.inference import emission_tracking, tracking
from vssm_gym.inference.emission_tracking import TRACKER_ADAM, step_emission
from vssm_gym.inference.tracking import LOST, OK, TrackerConfig, step_map
from vssm_gym.transition import planar_predict

STEPS = {
    "adam": functools.partial(step_map, config=TrackerConfig(adam=TRACKER_ADAM)),
    "emission": step_emission,
}


@pytest.mark.parametrize("name", STEPS)
def test_the_robot_is_tracked_in_its_map(name: str) -> None:
    state, offs = start(), []
    for command, planar in drive(12, 0):
        state, info = STEPS[name](state, jnp.asarray(command, jnp.float32), see(planar), MAP, RIG, NOISE)
        assert int(info.status) == OK
        off, turned = error(state, planar)
        offs.append(off)
        assert turned < np.radians(0.5)
    assert np.sqrt(np.mean(np.square(offs))) < 0.005


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize("kind", ["another place", "no depth"])
def test_images_that_do_not_fit_are_not_believed(name: str, kind: str) -> None:
    command = jnp.asarray(drive(1, 5)[0][0], jnp.float32)
    blind = tracking.observe(np.full((48, 64, 3), 128, np.uint8), np.zeros((48, 64), np.float32))
    bad = {"another place": see(ELSEWHERE), "no depth": blind}[kind]
    state, info = STEPS[name](start(), command, bad, MAP, RIG, NOISE)
    assert int(info.status) == LOST
    assert int(state.lost) == 1
    predicted = planar_predict(start().belief, command, NOISE)
    np.testing.assert_allclose(np.asarray(state.planar), np.asarray(predicted.planar), atol=1e-6)


def test_the_camera_stays_at_its_height() -> None:
    """The search moves along the body's planar twists only."""
    predicted, T = tracking.predict(start().belief, jnp.array([0.1, 0.0, 0.05]), NOISE, RIG)
    image = see(np.asarray(predicted.planar, float) + np.array([0.02, -0.01, 0.02]))
    config = emission_tracking.EmissionTrackerConfig()
    found = emission_tracking._descend(predicted, T, image, MAP, RIG, config)
    np.testing.assert_allclose(float(found[2, 3]), float(T[2, 3]), atol=1e-5)
    assert float(jnp.abs(found - T).max()) > 5e-3


def test_steps_are_deterministic() -> None:
    command, planar = drive(1, 9)[0]
    a, b = (
        step_emission(start(), jnp.asarray(command, jnp.float32), see(planar), MAP, RIG, NOISE)[0] for _ in range(2)
    )
    np.testing.assert_array_equal(np.asarray(a.planar), np.asarray(b.planar))
