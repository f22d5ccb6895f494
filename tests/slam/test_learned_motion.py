"""Test what SLAM makes of a learned transition: its level, its controls, what it refuses, and a flight."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.dynamics.transitions import random_transition
from tests.helpers.flight_hall import hall
from vssm_gym.data.flights import record_flight
from vssm_gym.data.sequences import load_sequence
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.eval.studies import flight as study_flight
from vssm_gym.model.transition.learned import Scales, together, untrained
from vssm_gym.model.transition.learned_file import calibrated, save_transition
from vssm_gym.slam.learned_motion import LearnedMotion, level_of, load_flight_transition
from vssm_gym.slam.options import SlamOptions
from vssm_gym.slam.run import run_slam

FAR = {"size": (64, 48), "rate": 20.0, "voxel": 0.25, "extent": 16.0, "max_depth": 20.0, "depth": "stereo"}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    out = tmp_path_factory.mktemp("flight") / "figure8"
    record_flight(hall(), out, flight="figure8", speed=4.0, camera=CameraConfig(64, 48), seed=1)
    return out


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """Return a file of two networks that correct nothing, with the noise of an integrated IMU."""
    errors = jnp.asarray(np.repeat([0.005, 0.002, 0.02, 0.05], 3), jnp.float32)
    scales = Scales(jnp.zeros(15), jnp.ones(15), errors, jnp.asarray(0.1))
    one = untrained(jax.random.key(0), calibrated("imu"), scales)
    path = tmp_path_factory.mktemp("transition") / "flight.npz"
    save_transition(path, together([one, one]), "imu", {})
    return path


@pytest.mark.parametrize("gravity", [[0.0, 9.81, 0.0], [1.0, -9.0, 3.0], [0.0, 0.0, -9.81], [0.0, 0.0, 9.81]])
def test_gravity_points_down_in_a_level_world(gravity):
    T = level_of(np.array(gravity))
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-9)
    down = T[:3, :3] @ gravity
    np.testing.assert_allclose(down, [0.0, 0.0, -np.linalg.norm(gravity)], atol=1e-9)


def test_a_resting_body_reads_gravity_and_the_bias_that_was_learned(recording, file):
    """Its gyroscope's own bias is removed: what is left is the one that the transition removes again."""
    learned = load_flight_transition(file)
    motion = LearnedMotion(learned, load_sequence(recording), 0.0)
    reading = motion(0.0, 0.4)
    np.testing.assert_allclose(reading[3:], learned.nominal.constants.gyro_bias, atol=0.05)
    assert abs(np.linalg.norm(reading[:3]) - 9.81) < 0.3
    camera_down = np.asarray(motion.transition.T_level_world)[:3, :3] @ [0.0, 1.0, 0.0]  # y of a level camera
    np.testing.assert_allclose(camera_down, [0.0, 0.0, -1.0], atol=0.05)


def test_readings_are_weighted_by_the_time_that_they_last(recording, file):
    """The means over two parts of a time give that over the whole; beyond the last reading it lasts."""
    motion = LearnedMotion(load_flight_transition(file), load_sequence(recording), 0.0)
    parts = 0.3 * motion(2.0, 2.3) + 0.2 * motion(2.3, 2.5)
    np.testing.assert_allclose(motion(2.0, 2.5), parts / 0.5, atol=1e-6)
    end = motion._times[-1]
    np.testing.assert_array_equal(motion(end + 1.0, end + 1.1), motion._readings[-1])


def test_a_transition_of_another_body_is_refused(tmp_path):
    save_transition(tmp_path / "car.npz", random_transition(calibrated("car")), "car", {})
    with pytest.raises(InputError, match="robot's commands"):
        SlamOptions(transition=tmp_path / "car.npz")
    save_transition(tmp_path / "thrust.npz", random_transition(calibrated("imu"), further=1), "imu", {})
    with pytest.raises(InputError, match="the transition reads 7"):
        SlamOptions(transition=tmp_path / "thrust.npz")
    with pytest.raises(InputError, match="train-dynamics"):
        SlamOptions(transition=tmp_path / "none.npz")


@pytest.mark.parametrize("other", [{"imu": True}, {"refine": True}])
def test_options_that_exclude_it_are_refused(file, other):
    with pytest.raises(InputError, match="transition"):
        SlamOptions(transition=file, **other)


def test_a_recording_without_readings_is_refused(recording, file, tmp_path):
    shutil.copytree(recording, tmp_path / "blind")
    (tmp_path / "blind" / "imu.txt").unlink()
    with pytest.raises(InputError, match=r"imu\.txt"):
        run_slam(load_sequence(tmp_path / "blind"), SlamOptions(transition=file, **FAR))


@pytest.mark.slow
def test_slam_follows_a_flight_by_a_learned_transition(recording, file):
    sequence = load_sequence(recording)
    run = run_slam(sequence, SlamOptions(transition=file, **FAR))
    row = study_flight.measured(run, sequence.true_poses())
    assert row["lost"] == 0
    assert row["ate_m"] < 0.3  # cells of 25 cm, images of 64 pixels
    assert run.frames[-1].covariance.shape == (12, 12)
