"""Test the IMU-driven body: laws of motion, its linearisation, and a real drone's IMU against motion capture."""

import gzip
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vssm_gym.model.transition import RIGID, Imu, ImuNoise, RigidState, rigid_belief

G = 9.81
R0 = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()


def state(velocity, R: np.ndarray = R0, t=(1.0, -2.0, 0.5)) -> RigidState:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return RigidState(jnp.asarray(T), jnp.asarray(np.asarray(velocity, float)))


def run(start: RigidState, control, dt: float, steps: int) -> RigidState:
    for _ in range(steps):
        start = Imu().mean(start, jnp.asarray(control), dt)
    return start


def test_a_resting_imu_stays() -> None:
    """At rest the accelerometer measures +g upwards for every attitude of the body."""
    control = np.concatenate([R0.T @ [0.0, 0.0, G], np.zeros(3)])
    after = run(state(np.zeros(6)), control.astype(np.float32), 0.1, 20)
    np.testing.assert_allclose(np.asarray(after.T_world_body), np.asarray(state(np.zeros(6)).T_world_body), atol=1e-5)
    np.testing.assert_allclose(np.asarray(after.velocity), 0.0, atol=1e-5)


def test_a_falling_imu_measures_zero_and_follows_its_parabola() -> None:
    """Two seconds at 10 Hz, tumbling: ``t = v t - g t^2 / 2`` exactly, ``R = R0 exp(w t)``."""
    rate = np.array([0.3, -0.8, 1.1])
    start = state([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    after = run(start, np.concatenate([np.zeros(3), rate]).astype(np.float32), 0.1, 20)
    expected = np.array([1.0, -2.0, 0.5]) + np.array([1.0, 2.0, 3.0]) * 2.0 - [0.0, 0.0, 0.5 * G * 4.0]
    R = R0 @ Rotation.from_rotvec(rate * 2.0).as_matrix()
    np.testing.assert_allclose(np.asarray(after.T_world_body[:3, 3]), expected, atol=1e-4)
    np.testing.assert_allclose(np.asarray(after.T_world_body[:3, :3]), R, atol=1e-5)
    np.testing.assert_allclose(np.asarray(after.velocity), [1.0, 2.0, 3.0 - G * 2.0, *(R @ rate)], atol=1e-4)


def test_a_body_on_a_circle_returns() -> None:
    """On a circle of 1 m at 1 rad/s, a body that faces along its path measures ``w^2 r`` to its left and g upwards."""
    n = 1256
    control = np.array([0.0, 1.0, G, 0.0, 0.0, 1.0], np.float32)
    start = state([1.0, 0.0, 0.0, 0.0, 0.0, 1.0], np.eye(3), (0.0, -1.0, 0.0))

    def step(s, _):
        s = Imu().mean(s, jnp.asarray(control), 2 * np.pi / n)
        return s, s.T_world_body[:3, 3]

    after, path = jax.lax.scan(step, start, length=n)
    np.testing.assert_allclose(np.asarray(after.T_world_body), np.asarray(start.T_world_body), atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(np.asarray(path), axis=1), 1.0, atol=0.02)


@pytest.mark.parametrize("dt", [0.005, 0.1])
def test_prediction_is_linearised_as_autodiff_does(dt: float) -> None:
    with jax.enable_x64(True):
        rng = np.random.default_rng(2)
        start, control = state(rng.normal(size=6)), jnp.asarray(rng.normal(size=6) * 4)
        root = rng.normal(size=(12, 12)) * 0.1
        P, noise = jnp.asarray(root @ root.T), ImuNoise()
        body = Imu(noise)
        mean = body.mean(start, control, dt)
        step = lambda xi: RIGID.error(mean, body.mean(RIGID.perturb(start, xi), control, dt))
        F = jax.jacfwd(step)(jnp.zeros(12))
        predicted = body.predict(rigid_belief(start, P), control, dt)
        expected = F @ P @ F.T + jnp.diag(noise.variances(dt))
        np.testing.assert_allclose(np.asarray(predicted.covariance), np.asarray(expected), rtol=1e-8, atol=1e-12)


def test_prediction_agrees_with_samples() -> None:
    """The prediction agrees with 1e5 bodies drawn from a belief, in which a tilt of a degree adds an acceleration."""
    n, rng = 100_000, np.random.default_rng(3)
    P = np.diag(np.repeat([0.02, 0.02, 0.1, 0.1], 3) ** 2)
    start = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), state([1.0, 0.5, 0.0, 0.2, 0.0, 0.3]))
    control = jnp.asarray([1.0, -2.0, 9.0, 1.0, 0.5, -2.0], jnp.float32)
    noise = ImuNoise(0.02, 0.03, 0.05, 0.04)
    starts = RIGID.perturb(start, jnp.asarray(rng.multivariate_normal(np.zeros(12), P, n), jnp.float32))
    body = Imu(noise)
    moved = body.sample(jax.random.key(0), starts, jnp.broadcast_to(control, (n, 6)), 0.1)
    predicted = body.predict(rigid_belief(start, jnp.asarray(P, jnp.float32)), control, 0.1)
    xi, covariance = np.asarray(RIGID.error(predicted.mean, moved), float), np.asarray(predicted.covariance, float)
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(xi.mean(axis=0) / scale, 0.0, atol=0.04)
    np.testing.assert_allclose(np.cov(xi.T) / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.03)


@pytest.fixture(scope="module")
def euroc(shared_data: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return EuRoC V1_01: IMU rows (t, gyro, accelerometer) at 200 Hz, true states at 20 Hz; s since the first."""
    folder = shared_data / "uav_imu" / "euroc_V1_01_easy"
    if not folder.is_dir():
        pytest.skip("no recording euroc_V1_01_easy")
    tables = []
    for name in ("imu0.csv.gz", "gt_openvins.csv.gz"):
        with gzip.open(folder / name, "rt") as file:
            rows = [line.strip().split(",") for line in file if not line.startswith("#")]
        # Nanoseconds since 1970 do not fit a double's digits: subtract as integers
        start = 1403715273262142976
        tables.append(np.array([[(int(r[0]) - start) * 1e-9, *map(float, r[1:])] for r in rows]))
    return tables[0], tables[1]


@pytest.mark.parametrize(("rate", "bound"), [(200, (0.04, 0.07, 0.2)), (20, (0.06, 0.08, 1.0))])
def test_a_real_imu_agrees_with_the_truth(euroc, rate: int, bound: tuple[float, float, float]) -> None:
    """One second of flight from 60 true states: median errors of position (m), velocity (m/s), rotation (degrees)."""
    readings, truth = euroc
    group = 200 // rate
    errors = []
    step = jax.jit(lambda s, u: jax.lax.scan(lambda s, u: (Imu().mean(s, u, 1.0 / rate), None), s, u)[0])
    for row in truth[400:-40:40][:60]:
        now = row[0]
        first = np.searchsorted(readings[:, 0], now - 1e-4)
        later = truth[np.argmin(np.abs(truth[:, 0] - now - 1.0))]
        used = readings[first : first + 200]
        if len(used) < 200 or abs(later[0] - now - 1.0) > 2e-3 or np.ptp(used[:, 0]) > 1.0:
            continue
        gyro, force = used[:, 1:4] - row[11:14], used[:, 4:7] - row[14:17]
        control = np.concatenate([force, gyro], axis=1).reshape(rate, group, 6).mean(axis=1)
        R = Rotation.from_quat(row[[5, 6, 7, 4]]).as_matrix()
        start = jax.tree.map(
            lambda a: jnp.asarray(a, jnp.float32), state([*row[8:11], 0.0, 0.0, 0.0], R, tuple(row[1:4]))
        )
        after = step(start, jnp.asarray(control, jnp.float32))
        T = np.asarray(after.T_world_body, float)
        turned = Rotation.from_matrix(T[:3, :3]).inv() * Rotation.from_quat(later[[5, 6, 7, 4]])
        errors.append(
            [
                np.linalg.norm(T[:3, 3] - later[1:4]),
                np.linalg.norm(np.asarray(after.velocity)[:3] - later[8:11]),
                np.degrees(turned.magnitude()),
            ]
        )
    assert len(errors) > 40
    median = np.median(errors, axis=0)
    assert (median < bound).all(), median
