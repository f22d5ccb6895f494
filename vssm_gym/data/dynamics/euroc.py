"""Read flights of the EuRoC data set (Burri et al. 2016) from csv files: readings of the IMU, and true states.

A folder holds ``imu0.csv`` (ns; rate in rad/s; specific force in m/s^2) and a file of states: the pose of the IMU in a
world whose z points up, its velocity in it, and more columns that are not read: ``t[ns] p q_wxyz v``. Either may be
packed by gzip. The layout of the original archives (``imu0/data.csv``, ``state_groundtruth_estimate0/data.csv``) is
read too.
"""

import gzip
import io
import zlib
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from vssm_gym.data.dynamics.log import DynamicsLog, measured_velocity
from vssm_gym.data.trajectories import LATEST
from vssm_gym.errors import InputError
from vssm_gym.files.bounded import is_file, open_file
from vssm_gym.files.numbers import LARGEST_NUMBER

CSV_BYTES = 256 << 20  # unpacked; an hour at 200 Hz has 100 MB
IMU_FILES = ("imu0.csv.gz", "imu0.csv", "imu0/data.csv", "mav0/imu0/data.csv")
STATES = "state_groundtruth_estimate0"
STATE_FILES = (
    "gt_openvins.csv.gz",
    "gt_openvins.csv",
    f"{STATES}.csv",
    f"{STATES}/data.csv",
    f"mav0/{STATES}/data.csv",
)


def find(folder: Path, names: tuple[str, ...]) -> Path | None:
    """Return the first of several files that a folder has."""
    return next((folder / name for name in names if is_file(folder / name)), None)


def read_euroc(folder: str | Path) -> DynamicsLog:
    """Read one flight.

    Raises:
        InputError: a file is missing, is neither csv nor csv packed by gzip, or has a line that is not numbers.
    """
    folder = Path(folder)
    imu_path, state_path = find(folder, IMU_FILES), find(folder, STATE_FILES)
    if imu_path is None or state_path is None:
        name, names = ("IMU readings", IMU_FILES) if imu_path is None else ("true states", STATE_FILES)
        raise InputError(folder, name, f"one of {', '.join(names)}")
    imu, states = _read(imu_path, 7), _read(state_path, 11)
    quaternion = states[:, [5, 6, 7, 4]]
    if (np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > 0.01).any():
        raise InputError(state_path, "quaternion", "unit quaternions in columns 5 to 8")
    T = np.tile(np.eye(4), (len(states), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(quaternion).as_matrix(), states[:, 1:4]
    start = imu[0, 0]  # subtracted as integers' floats: 1e18 ns leave 128 ns of resolution
    times = (states[:, 0] - start) * 1e-9
    angular = measured_velocity(times, T)[:, 3:]
    velocity = np.concatenate([states[:, 8:11], angular], axis=1)
    controls = imu[:, [4, 5, 6, 1, 2, 3]]
    return DynamicsLog(str(folder), "imu", times, T, (imu[:, 0] - start) * 1e-9, controls, velocity)


def _read(path: Path, columns: int) -> np.ndarray:
    """Return the first columns of a csv file ``(rows, columns)``; lines that begin with ``#`` are comments."""
    with open_file(path, "a csv file") as file:
        try:
            packed = gzip.GzipFile(fileobj=file) if path.suffix == ".gz" else file
            content = packed.read(CSV_BYTES + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise InputError(path, "file", f"csv packed by gzip ({error})") from error
    if len(content) > CSV_BYTES:
        raise InputError(path, "file", f"at most {CSV_BYTES:,} bytes")
    expected = f"lines of at least {columns} finite numbers, separated by commas"
    try:
        text = io.StringIO(content.decode("utf-8"))
        rows = np.loadtxt(text, delimiter=",", comments="#", usecols=range(columns), ndmin=2)
    except (ValueError, IndexError) as error:
        raise InputError(path, "lines", f"{expected} ({error})") from error
    if len(rows) == 0 or not (np.abs(rows[:, 0]) <= LATEST).all() or not (np.abs(rows[:, 1:]) <= LARGEST_NUMBER).all():
        raise InputError(path, "lines", expected)
    return rows
