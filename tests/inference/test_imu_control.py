"""Test the IMU as PRISM's control: with exact readings the rigid body follows the flight in any orientation."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vssm_gym.data.sequences import imu_line
from vssm_gym.envs.flight_body import FlightBody
from vssm_gym.envs.tasks.reference_flights import HOVER, Placement, ReferenceFlight
from vssm_gym.errors import InputError
from vssm_gym.geometry.gravity import GRAVITY
from vssm_gym.geometry.transforms import inverse
from vssm_gym.inference.prism.imu_control import ImuControl
from vssm_gym.model.transition import Rigid, RigidState

FLIGHT = ReferenceFlight("star", 3.0, Placement((0.0, 0.0), 4.0, 0.4))
T_BODY_CAM = FlightBody().T_body_cam
DT, SUBSTEPS = 0.05, 10


def flown(bias=0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return image times, poses and velocities of the camera in the first one's frame, and readings of ``imu.txt``."""
    times = np.arange(0.0, HOVER + 4.0, DT)
    t = np.arange(1, len(times) * SUBSTEPS) * DT / SUBSTEPS
    middle = FLIGHT.at(t - 0.5 * DT / SUBSTEPS)
    force = np.einsum("nji,nj->ni", middle.R_world_body, middle.acceleration - GRAVITY)
    rates = FLIGHT.body_rates(t - 0.5 * DT / SUBSTEPS) + bias
    motion = FLIGHT.at(times)
    T_world_body = np.tile(np.eye(4), (len(times), 1, 1))
    T_world_body[:, :3, :3], T_world_body[:, :3, 3] = motion.R_world_body, motion.position
    T_first_world = inverse(T_world_body[0] @ T_BODY_CAM)
    velocity = motion.velocity @ T_first_world[:3, :3].T
    return times, T_first_world @ T_world_body @ T_BODY_CAM, velocity, np.column_stack([t, rates, force])


def test_dead_reckoning_with_the_controls_is_the_flight():
    """The velocity is updated first, so a step of constant acceleration ends a dt^2 / 2, here 4 mm, too far."""
    times, poses, velocities, readings = flown(bias=0.05)
    control = ImuControl(readings, T_BODY_CAM, times[0])
    np.testing.assert_allclose(control.gyro_bias, 0.05, atol=1e-6)
    np.testing.assert_allclose(control.gravity, [0.0, 9.81, 0.0], atol=1e-6)  # down is the camera's y
    state = RigidState(jnp.asarray(poses[0], jnp.float32), jnp.zeros(6))
    for before, now, truth, velocity in zip(times, times[1:], poses[1:], velocities[1:], strict=False):
        u = control(np.asarray(state.T_world_body), np.asarray(state.velocity)[3:], before, now)
        state = Rigid().mean(state, jnp.asarray(u, jnp.float32), now - before)
        turn = np.asarray(state.T_world_body)[:3, :3].T @ truth[:3, :3]
        assert np.linalg.norm(Rotation.from_matrix(turn).as_rotvec()) < 2e-3
        np.testing.assert_allclose(np.asarray(state.velocity)[:3], velocity, atol=0.02)
    moved = np.linalg.norm(poses[-1, :3, 3])
    assert moved > 5.0
    assert np.linalg.norm(np.asarray(state.T_world_body)[:3, 3] - poses[-1, :3, 3]) < 0.15


def test_without_readings_it_is_constant_velocity():
    _, poses, _, readings = flown()
    control = ImuControl(readings, T_BODY_CAM, 0.0)
    np.testing.assert_array_equal(control(poses[0], np.ones(3), 90.0, 91.0), np.zeros(6))


def test_a_moving_start_is_refused():
    _, _, _, readings = flown()
    with pytest.raises(InputError, match="at rest"):
        ImuControl(readings + np.sin(20.0 * readings[:, :1]) * np.eye(7)[4], T_BODY_CAM, 0.0)
    with pytest.raises(InputError, match="readings within"):
        ImuControl(readings, T_BODY_CAM, 90.0)


def test_a_line_of_imu_txt():
    assert imu_line(1.5, np.array([0.1, -0.2, 0.3, 0.0, 0.0, 9.81])) == "1.500000 0.1 -0.2 0.3 0 0 9.81\n"
