"""Record a room known in closed form, for the tests of ``vssm-gym slam``."""

from pathlib import Path

import numpy as np

from tests.helpers.analytic_room import Room, camera_pose
from vssm_gym.data.sequences import SequenceWriter
from vssm_gym.data.trajectories import read_trajectory
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import R_BODY_CAM
from vssm_gym.slam.options import SlamOptions

FRAMES = 10
SIZE = "80x60"  # one size and one grid everywhere, since each compiles the step again
GRID = ("--voxel", "0.08", "--extent", "6.4")
CAMERA = Camera.from_hfov(80, 60, np.radians(70.0))
ROOM = Room(((-2.0, -1.6, 0.0), (2.2, 1.7, 2.3)), (((0.9, -0.4, 0.0), (1.4, 0.5, 0.8)),))
FILES = ["map.npz", "mesh.ply", "report.html", "slam.json", "stats.json", "trajectory.txt"]


def true_pose(k: int) -> np.ndarray:
    """Return the pose of a hand that moves 2 to 3 cm and about a degree a frame."""
    place = (-0.8 + 0.025 * k, 0.2 * np.sin(0.25 * k), 1.1 + 0.05 * np.sin(0.4 * k))
    return camera_pose(place, 0.02 * k - 0.1, 0.2 + 0.01 * k, 0.01 * k)


def image_from(T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return RGB uint8 and z-depth (m)."""
    image = ROOM.image(T_world_cam, CAMERA)
    return np.rint(255.0 * np.asarray(image.rgb)).astype(np.uint8), np.asarray(image.depth)


def frame_of(k: int) -> tuple[np.ndarray, np.ndarray]:
    return image_from(true_pose(k))


def write_sequence(
    folder: Path, strange: int | None = None, blank: int = 0, first: tuple[np.ndarray, np.ndarray] | None = None
) -> Path:
    """Write a TUM folder of the room; frame ``strange`` looks backwards, the first ``blank`` frames have no depth.

    ``first`` takes the place of the first image.
    """
    T_body_cam = np.eye(4)
    T_body_cam[:3, :3] = R_BODY_CAM
    writer = SequenceWriter(folder, CAMERA, T_body_cam)
    for k in range(FRAMES):
        rgb, depth = frame_of(k) if k != strange else image_from(camera_pose((0.3, 0.0, 1.2), 2.8, 0.4))
        rgb, depth = (rgb, depth) if first is None or k else first
        writer.append(1000.0 + 0.1 * k, rgb, depth * (k >= blank), true_pose(k), np.zeros(0))
    writer.close()
    return folder


def poses_of(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and poses, and check that the file has a line for each."""
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    times, poses = read_trajectory(path)
    assert len(lines) == len(times)
    return times, poses


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def options(**changes) -> SlamOptions:
    return SlamOptions(size=(80, 60), voxel=0.08, extent=6.4, **changes)
