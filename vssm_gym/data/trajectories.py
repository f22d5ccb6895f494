"""Read and write trajectories of T_world_cam: TUM text (``t x y z qx qy qz qw``) and EuRoC csv (``t[ns] p q_wxyz``)."""

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import check_lines, read_bytes
from vssm_gym.files.numbers import LARGEST_NUMBER

TRAJECTORY_BYTES = 64 << 20  # of an index or a trajectory
TRAJECTORY_LINES = 800_000  # an hour at 200 Hz has 720,000
LATEST = 1e19  # the largest stamp; those of EuRoC are nanoseconds since 1970, 1e18 of them


def numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of the lines that are neither blank nor comments.

    Raises:
        InputError: the file is not text, or is larger than any recording's.
    """
    content = read_bytes(path, TRAJECTORY_BYTES, "text")
    check_lines(content, TRAJECTORY_LINES, path)
    try:
        for number, line in enumerate(io.TextIOWrapper(io.BytesIO(content), encoding="utf-8"), start=1):
            text = line.strip()
            if text and not text.startswith("#"):
                yield number, text
    except UnicodeDecodeError as error:
        raise InputError(path, "file", "text, in UTF-8") from error


def read_trajectory(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Read times (n,), s, and poses (n, 4, 4), sorted by time; ``.csv`` is EuRoC's format, anything else TUM's.

    Raises:
        InputError: missing file, a line that is not numbers, too few columns, or a zero quaternion.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "file", "an existing trajectory (TUM text or EuRoC csv)")
    euroc = path.suffix == ".csv"
    rows = []
    for number, text in numbered_lines(path):
        try:
            row = [float(word) for word in (text.split(",") if euroc else text.replace(",", " ").split())]
        except ValueError:
            raise InputError(path, f"line {number}", "numbers only") from None
        if len(row) < 8 or not abs(row[0]) <= LATEST or not all(abs(value) <= LARGEST_NUMBER for value in row[1:8]):
            expected = f"8 finite numbers: time, position, quaternion; none beyond {LARGEST_NUMBER:g}"
            raise InputError(path, f"line {number}", expected)
        rows.append(row[:8])
    if not rows:
        raise InputError(path, "file", "at least one pose")
    data = np.array(rows)
    data = data[np.argsort(data[:, 0], kind="stable")]
    times = data[:, 0] * (1e-9 if euroc else 1.0)
    quaternion = data[:, [5, 6, 7, 4]] if euroc else data[:, 4:8]
    if (np.linalg.norm(quaternion, axis=1) < 1e-9).any():
        raise InputError(path, "quaternion", "a rotation: one of the quaternions is zero")
    T = np.tile(np.eye(4), (len(data), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T[:, :3, 3] = data[:, 1:4]
    return times, T


def from_tum(values: np.ndarray) -> np.ndarray:
    """Return ``T_world_cam`` (4, 4) of a TUM line without its stamp: ``x y z qx qy qz qw``."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return T


def tum_line(time: float, T_world_cam: np.ndarray) -> str:
    """Format one line of a TUM trajectory."""
    q = Rotation.from_matrix(T_world_cam[:3, :3]).as_quat()
    numbers = " ".join(f"{value:.7f}" for value in (*T_world_cam[:3, 3], *q))
    return f"{time:.6f} {numbers}\n"


def write_trajectory(path: str | Path, times: np.ndarray, T_world_cam: np.ndarray) -> None:
    """Write a trajectory as lines ``time tx ty tz qx qy qz qw`` (TUM format); the file is complete or absent.

    Args:
        path: the file; one that exists is replaced.
        times: ``(n,)`` stamps, s.
        T_world_cam: ``(n, 4, 4)`` pose of the camera at each of them, m.

    Raises:
        InputError: not one pose for each time.
    """
    if np.shape(T_world_cam) != (len(times), 4, 4):
        raise InputError(path, "T_world_cam", f"({len(times)}, 4, 4) poses; found {np.shape(T_world_cam)}")
    with atomic_write(path) as temporary, temporary.open("w") as file:
        file.write("# timestamp tx ty tz qx qy qz qw\n")
        file.writelines(tum_line(t, T) for t, T in zip(times, T_world_cam, strict=True))


def interpolate(times: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate poses ``(m, 4, 4)`` at times ``at``: linear in position, geodesic in rotation; clamped to the ends.

    ``times`` are non-decreasing; of poses with the same time the first one counts.
    """
    times, first = np.unique(times, return_index=True)
    poses = poses[first]
    at = np.clip(at, times[0], times[-1])
    result = np.tile(np.eye(4), (len(at), 1, 1))
    if len(times) == 1:
        return np.tile(poses[0], (len(at), 1, 1))
    result[:, :3, :3] = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    result[:, :3, 3] = np.stack([np.interp(at, times, poses[:, a, 3]) for a in range(3)], axis=1)
    return result


def velocities(times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """``t' = t + v dt``, ``R' = exp(w dt) R``: world-frame velocities that lead exactly from each pose to the next.

    Returns:
        ``(n - 1, 6)``: linear (m/s), angular (rad/s).
    """
    dt = np.diff(times)[:, None]
    turn = Rotation.from_matrix(poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], 1, 2)).as_rotvec()
    return np.concatenate([np.diff(poses[:, :3, 3], axis=0), turn], axis=1) / dt
