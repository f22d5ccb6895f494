"""Hold a corridor around a block, a drive through it with drifting odometry, and its scans."""

import numpy as np

from vssm_gym.data.laser_logs import LaserLog
from vssm_gym.envs.physics.planar import scan
from vssm_gym.geometry.planar_poses import compose, relation

BEAMS = 120
REACH = 3.0  # m
ALONG = 1.0, 9.0  # m: the middle of the corridor, a square


def box(x0, x1, y0, y1):
    return [0.5 * (x0 + x1), 0.5 * (y0 + y1), 1.0, 0.0, 0.5 * (x1 - x0), 0.5 * (y1 - y0)]


WALLS = np.array(
    [
        box(-0.2, 0.0, -0.2, 10.2),
        box(10.0, 10.2, -0.2, 10.2),
        box(-0.2, 10.2, -0.2, 0.0),
        box(-0.2, 10.2, 10.0, 10.2),
        box(2.0, 8.0, 2.0, 8.0),
        box(1.5, 1.9, 0.0, 0.5),  # three cupboards in corners
        box(0.0, 0.3, 1.3, 2.0),
        box(8.7, 9.2, 0.0, 0.2),
    ]
)


def poses_at(laps, step=0.1):
    """Return poses along the middle of the corridor, with turns on the spot of 15 degrees."""
    pose, poses = np.array([ALONG[0] + 1.0, ALONG[0], 0.0]), []
    side = round((ALONG[1] - ALONG[0]) / step)
    for k in range(4 * laps):
        for _ in range(side - (10 if k == 0 else 0)):
            poses.append(pose)
            pose = compose(pose, np.array([step, 0.0, 0.0]))
        for _ in range(6):
            poses.append(pose)
            pose = compose(pose, np.array([0.0, 0.0, np.pi / 12]))
    for _ in range(30):
        poses.append(pose)
        pose = compose(pose, np.array([step, 0.0, 0.0]))
    return np.array(poses)


def scans(poses, seed=0, walls=WALLS, noise=0.01):
    """Return ranges with noise, 0 beyond the reach."""
    ranges = scan(np.asarray(poses, float), walls, BEAMS)
    ranges += noise * np.random.default_rng(seed).normal(size=ranges.shape)
    return np.where(ranges < REACH, ranges, 0.0).astype(np.float32)


def drive(laps=1, seed=0, too_long=0.12, turn=0.002):
    """Return a log whose odometry measures distances too long at first and too short in the end, and turns a little."""
    poses = poses_at(laps)
    true = relation(poses[:-1], poses[1:])
    scale = 1.0 + too_long * np.linspace(1.0, -1.0, len(true))
    rng = np.random.default_rng(seed)
    motions = true * np.stack([scale, np.ones_like(scale), np.ones_like(scale)], axis=-1) + rng.normal(
        size=true.shape
    ) * [0.002, 0.002, turn]
    angles = 2.0 * np.pi * np.arange(BEAMS) / BEAMS
    return LaserLog(
        scans(poses, seed), angles, REACH, np.zeros(3), motions, poses, np.zeros((0, 2), int), np.zeros((0, 3))
    )
