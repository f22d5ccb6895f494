"""Make logs of known motion, and write them in the formats of the data sets."""

import gzip
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vssm_gym.data.dynamics.log import DynamicsLog

GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s^2


def circling(seconds: float, rate: float = 100.0) -> DynamicsLog:
    """Return a body on a circle of two metres at 2 m/s, level, heading along it, with an ideal IMU."""
    times, radius, speed = np.arange(0.0, seconds, 1.0 / rate), 2.0, 2.0
    angle = speed / radius * times
    c, s, zero = np.cos(angle), np.sin(angle), np.zeros_like(angle)
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec((angle + 0.5 * np.pi)[:, None] * [0.0, 0.0, 1.0]).as_matrix()
    T[:, :3, 3] = np.stack([radius * c, radius * s, zero + 1.0], axis=1)
    velocity = np.stack([-speed * s, speed * c, zero, zero, zero, zero + speed / radius], axis=1)
    controls = np.tile([0.0, speed**2 / radius, 9.81, 0.0, 0.0, speed / radius], (len(times), 1))
    return DynamicsLog("circling", "imu", times, T, times, controls, velocity)


def dragged(seconds: float, seed: int, bias: np.ndarray, drag: float = 0.3, rate: float = 50.0) -> DynamicsLog:
    """Return a body that random forces push about, level, with a drag that its accelerometer does not show.

    Args:
        seconds: of the log.
        seed: of forces and turns.
        bias: of the accelerometer (m/s^2) and the gyroscope (rad/s), six numbers.
        drag: 1/s.
        rate: Hz, of the log.
    """
    rng, dt, count = np.random.default_rng(seed), 1.0 / rate, int(seconds * rate)
    slow = lambda size, std: np.repeat(rng.normal(0.0, std, (count // 25 + 1, size)), 25, axis=0)[:count]
    push, turn = np.concatenate([slow(2, 1.0), np.zeros((count, 1))], axis=1), slow(1, 0.5)[:, 0]
    yaw, v, p = 0.0, np.zeros(3), np.zeros(3)
    T, velocity, controls = np.tile(np.eye(4), (count, 1, 1)), np.zeros((count, 6)), np.zeros((count, 6))
    for k in range(count):
        R = Rotation.from_euler("z", yaw).as_matrix()
        T[k, :3, :3], T[k, :3, 3], velocity[k, :3], velocity[k, 5] = R, p, v, turn[k]
        controls[k] = np.concatenate([push[k] - R.T @ GRAVITY, [0.0, 0.0, turn[k]]]) + bias
        after = v + (R @ push[k] - drag * v) * dt
        p, v, yaw = p + 0.5 * (v + after) * dt, after, yaw + turn[k] * dt
    times = np.arange(count) * dt
    return DynamicsLog("dragged", "imu", times, T, times, controls, velocity)


def write_blackbird(path: Path, log: DynamicsLog) -> Path:
    """Write a log as a flight of the Blackbird data set."""

    import h5py  # only where a test writes such a file

    quaternion = Rotation.from_matrix(log.T_world_body[:, :3, :3]).as_quat()
    with h5py.File(path, "w") as stored:
        stored["ts"] = log.times + 1.5e9
        stored["accel_calib"], stored["gyro_calib"] = log.controls[:, :3], log.controls[:, 3:]
        stored["thrust"] = log.controls[:, :3] * [0.0, 0.0, 1.0]
        stored["traj_target"] = np.concatenate([log.T_world_body[:, :3, 3], quaternion], axis=1)
    return path


def write_euroc(folder: Path, log: DynamicsLog, packed: bool = False) -> Path:
    """Write a log as a flight of the EuRoC data set, packed by gzip or not."""
    q = Rotation.from_matrix(log.T_world_body[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    assert log.velocity is not None
    stamps = [f"{1_403_715_273_262_142_976 + round(1e9 * t)}" for t in log.times]
    files = {
        "imu0.csv": log.controls[:, [3, 4, 5, 0, 1, 2]],
        "gt_openvins.csv": np.concatenate([log.T_world_body[:, :3, 3], q, log.velocity[:, :3]], axis=1),
    }
    for name, rows in files.items():
        lines = [",".join([stamp, *(f"{x:.9f}" for x in row)]) for stamp, row in zip(stamps, rows, strict=True)]
        content = ("#timestamp [ns]\n" + "\n".join(lines) + "\n").encode()
        if packed:
            (folder / f"{name}.gz").write_bytes(gzip.compress(content))
        else:
            (folder / name).write_bytes(content)
    return folder


def lagging(seconds: float, seed: int) -> DynamicsLog:
    """Return a holonomic robot that lags behind its commands, slips, and pulls to the right as it drives.

    The executed command is ``c' = c + 0.4 (u - c)``; of it the robot turns 80 % and drives 85 %, and it turns by
    0.1 rad a metre to the right; two per cent of each is noise.
    """
    rng, dt, count = np.random.default_rng(seed), 0.2, round(seconds / 0.2)
    held = lambda low, high: np.repeat(rng.uniform(low, high, count // 8 + 1), 8)[:count]
    commands = np.stack([held(-0.2, 0.2), held(-0.08, 0.08), held(0.0, 0.16)], axis=1)
    pose, executed, poses = np.zeros(3), np.zeros(3), [np.zeros(3)]
    for u in commands:
        executed = executed + 0.4 * (u - executed)
        turn, offset, step = executed * [0.8, 1.0, 0.85] * (1.0 + 0.02 * rng.standard_normal(3))
        phi = pose[2] + offset
        pose = pose + np.array([step * np.cos(phi), step * np.sin(phi), turn - 0.1 * step])
        poses.append(pose)
    planar = np.array(poses)
    T = np.tile(np.eye(4), (count + 1, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(planar[:, 2:] * [0.0, 0.0, 1.0]).as_matrix()
    T[:, :2, 3] = planar[:, :2]
    times = dt * np.arange(count + 1)
    return DynamicsLog("lagging", "holonomic", times, T, times[1:], commands)
