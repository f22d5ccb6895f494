"""Test the simulated IMU: the model integrates its readings to the trajectory; errors follow the stated laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vssm_gym.envs.sensors.imu import PRESETS, ImuSensorNoise, NoisyImu, imu_noise, readings, specific_force
from vssm_gym.errors import InputError
from vssm_gym.model.transition import Imu, RigidState


def flight(seconds: float, dt: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return poses ``(n, 4, 4)`` and world velocities ``(n, 3)`` of a smooth tumbling flight, in closed form."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds + dt / 2, dt)[:, None]
    amplitude, phase, speed = rng.uniform(0.3, 2.0, 3), rng.uniform(-3, 3, 3), rng.uniform(0.5, 2.5, 3)
    angles = rng.uniform(-1.5, 1.5, 3) * np.sin(rng.uniform(0.3, 2.0, 3) * t + rng.uniform(-3, 3, 3))
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
    T[:, :3, 3] = amplitude * np.sin(speed * t + phase)
    return T, amplitude * speed * np.cos(speed * t + phase)


def integrated(T: np.ndarray, v: np.ndarray, controls: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Integrate readings to poses and velocities by :meth:`vssm_gym.model.transition.imu.Imu.mean`."""
    start = RigidState(jnp.asarray(T[0], jnp.float32), jnp.asarray(np.r_[v[0], np.zeros(3)], jnp.float32))

    def step(state: RigidState, control: jax.Array) -> tuple[RigidState, tuple[jax.Array, jax.Array]]:
        state = Imu().mean(state, control, dt)
        return state, (state.T_world_body, state.velocity[:3])

    _, (poses, velocities) = jax.lax.scan(step, start, jnp.asarray(controls, jnp.float32))
    return np.asarray(poses), np.asarray(velocities)


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("rate", [50.0, 200.0])
def test_the_model_integrates_the_readings_to_the_trajectory(rate: float, seed: int) -> None:
    """Over ten seconds, orientation and velocity are exact to rounding, position to the error of the trapezoid rule."""
    T, v = flight(10.0, 1.0 / rate, seed)
    poses, velocities = integrated(T, v, readings(T, v, 1.0 / rate), 1.0 / rate)
    np.testing.assert_allclose(poses[:, :3, :3], T[1:, :3, :3], atol=2e-4)
    np.testing.assert_allclose(velocities, v[1:], atol=2e-3)
    np.testing.assert_allclose(poses[:, :3, 3], T[1:, :3, 3], atol=0.01)


def test_a_wrong_gravity_or_frame_misses_by_metres() -> None:
    """The test above can fail: gravity of the wrong sign, or rates of the other frame, miss by metres."""
    T, v = flight(10.0, 0.02, 0)
    exact = readings(T, v, 0.02)
    up = exact + np.concatenate([2.0 * np.einsum("nji,j->ni", T[:-1, :3, :3], [0, 0, -9.81]), np.zeros((500, 3))], 1)
    world = np.concatenate([exact[:, :3], np.einsum("nij,nj->ni", T[:-1, :3, :3], exact[:, 3:])], axis=1)
    for wrong in (up, world):
        assert np.abs(integrated(T, v, wrong, 0.02)[0][-1, :3, 3] - T[-1, :3, 3]).max() > 1.0


@given(st.tuples(*[st.floats(-3, 3)] * 3))
def test_specific_force_is_minus_gravity_at_rest_and_zero_in_free_fall(angles: tuple[float, float, float]) -> None:
    R = Rotation.from_euler("ZYX", angles).as_matrix()
    np.testing.assert_allclose(specific_force(R, np.zeros(3)), R.T @ [0.0, 0.0, 9.81], atol=1e-12)
    np.testing.assert_allclose(specific_force(R, np.array([0.0, 0.0, -9.81])), np.zeros(3), atol=1e-12)


@pytest.mark.parametrize("rate", [10.0, 200.0, 1000.0])
def test_white_noise_is_its_density_times_the_root_of_the_rate(rate: float) -> None:
    noise = ImuSensorNoise(accel_density=0.02, gyro_density=0.003)
    read = NoisyImu(noise, np.random.default_rng(0))(np.zeros((20_000, 6)), 1.0 / rate)
    np.testing.assert_allclose(read.std(axis=0), np.repeat([0.02, 0.003], 3) * np.sqrt(rate), rtol=0.03)
    assert np.abs(np.corrcoef(read.T) - np.eye(6)).max() < 0.03
    assert np.abs(np.mean(read[1:] * read[:-1], axis=0) / read.var(axis=0)).max() < 0.03


@pytest.mark.parametrize("dt", [0.005, 0.1])
def test_the_bias_is_a_random_walk(dt: float) -> None:
    """Its variance after a time t is ``walk^2 t`` at every rate."""
    noise = ImuSensorNoise(accel_walk=0.01, gyro_walk=0.002)
    for seconds in (1.0, 4.0):
        ends = []
        for seed in range(400):
            sensor = NoisyImu(noise, np.random.default_rng(seed))
            sensor(np.zeros((round(seconds / dt), 6)), dt)
            ends.append(sensor.bias)
        expected = np.repeat([0.01, 0.002], 3) * np.sqrt(seconds)
        np.testing.assert_allclose(np.std(ends, axis=0), expected, rtol=0.15)


def test_allan_deviation_falls_and_rises_as_specified() -> None:
    """``density / sqrt(tau)`` while noise dominates clusters of time tau, ``walk sqrt(tau / 3)`` once the bias does."""
    noise, dt, n = ImuSensorNoise(gyro_density=1e-3, gyro_walk=1e-3), 0.01, 2**18
    read = NoisyImu(noise, np.random.default_rng(0))(np.zeros((n, 6)), dt)[:, 3:]
    for length in (4, 16, 2048):
        means = read.reshape(-1, length, 3).mean(axis=1)
        deviation = np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2))
        tau = length * dt
        assert deviation == pytest.approx(np.sqrt(1e-6 / tau + 1e-6 * tau / 3.0), rel=0.1)


def test_the_initial_bias_is_random() -> None:
    biases = [NoisyImu(PRESETS["realsense"], np.random.default_rng(seed)).bias for seed in range(1000)]
    expected = np.repeat([PRESETS["realsense"].accel_bias, PRESETS["realsense"].gyro_bias], 3)
    np.testing.assert_allclose(np.std(biases, axis=0), expected, rtol=0.08)
    np.testing.assert_allclose(np.mean(biases, axis=0) / expected, 0.0, atol=0.1)


@pytest.mark.parametrize("name", PRESETS)
def test_the_same_stream_gives_the_same_bytes_in_any_portions(name: str) -> None:
    exact = np.random.default_rng(1).standard_normal((60, 6))
    whole = NoisyImu(PRESETS[name], np.random.default_rng(2))(exact, 0.01)
    parts, singly = (NoisyImu(PRESETS[name], np.random.default_rng(2)) for _ in range(2))
    assert np.concatenate([parts(exact[:17], 0.01), parts(exact[17:], 0.01)]).tobytes() == whole.tobytes()
    assert np.stack([singly(row, 0.01) for row in exact]).tobytes() == whole.tobytes()
    assert (name == "none") == np.array_equal(whole, exact)


@pytest.mark.parametrize("change", [{"accel_density": -1.0}, {"gyro_walk": np.nan}, {"gyro_bias": np.inf}])
def test_impossible_noise_is_refused(change: dict) -> None:
    with pytest.raises(InputError, match="ImuSensorNoise"):
        ImuSensorNoise(**change)
    with pytest.raises(InputError, match="one of none, adis16448, realsense"):
        imu_noise("perfect")
