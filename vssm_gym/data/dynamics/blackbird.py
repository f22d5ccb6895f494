"""Read flights of the Blackbird data set (Antonini et al. 2020) from HDF5, as inertial odometry distributes them.

One file is one flight, every data set with one row a stamp: ``ts`` (s), ``accel_calib`` (specific force, m/s^2) and
``gyro_calib`` (rad/s) in the frame of the IMU, ``thrust`` (specific force of the rotors in that frame, from their
speeds; its third component is not zero) and ``traj_target`` (position in m, quaternion ``x y z w``: the IMU in a world
whose z points up, by motion capture). Controls are ``(accel, gyro, thrust_z)``.
"""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vssm_gym.data.dynamics.log import DynamicsLog
from vssm_gym.errors import InputError
from vssm_gym.files.bounded import open_file
from vssm_gym.files.numbers import LARGEST_NUMBER

FLIGHT_ROWS = 2_000_000  # of a file at most: five hours at 100 Hz
FIELDS = {"ts": 0, "accel_calib": 3, "gyro_calib": 3, "thrust": 3, "traj_target": 7}  # columns of each; 0: a vector


def read_blackbird(path: str | Path) -> DynamicsLog:
    """Read one flight.

    Raises:
        InputError: h5py is not installed, the file is not HDF5, or a data set is missing, of another shape or holds
            numbers that are not finite.
    """
    try:
        import h5py
    except ImportError as error:
        raise InputError(
            path, "h5py", "this library to read HDF5: pip install -c constraints.txt '.[dynamics]'"
        ) from error
    with open_file(path, "an HDF5 file of a Blackbird flight") as file:
        try:
            with h5py.File(file, "r") as stored:
                columns = {name: _read(stored.get(name), path, name, width) for name, width in FIELDS.items()}
        except InputError:
            raise
        except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
            raise InputError(path, "file", f"an HDF5 file of a Blackbird flight ({error})") from error
    rows = {len(values) for values in columns.values()}
    if len(rows) != 1:
        raise InputError(path, "rows", f"as many in every data set; found {sorted(rows)}")
    quaternion = columns["traj_target"][:, 3:]
    if (np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) > 0.01).any():
        raise InputError(path, "traj_target", "unit quaternions in columns 4 to 7")
    T = np.tile(np.eye(4), (len(quaternion), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T[:, :3, 3] = columns["traj_target"][:, :3]
    times = columns["ts"] - columns["ts"][0]
    controls = np.concatenate([columns["accel_calib"], columns["gyro_calib"], columns["thrust"][:, 2:]], axis=1)
    return DynamicsLog(str(path), "imu", times, T, times, controls)


def _read(data: Any, path: str | Path, name: str, width: int) -> np.ndarray:
    """Return a data set ``(rows,)`` or ``(rows, width)`` in float64."""
    shape: Any = getattr(data, "shape", None)
    kind = getattr(getattr(data, "dtype", None), "kind", "")
    fits = shape is not None and shape[1:] == ((width,) if width else ()) and kind in "fiu" and kind != ""
    if not fits or not 0 < shape[0] <= FLIGHT_ROWS:
        of = f"(rows, {width})" if width else "(rows,)"
        raise InputError(path, name, f"a data set of numbers {of}, of at most {FLIGHT_ROWS:,} rows; found {shape}")
    values = np.asarray(data[()], np.float64)
    if not (np.abs(values) <= max(LARGEST_NUMBER, 1e10)).all():  # stamps are seconds since 1970
        raise InputError(path, name, "finite numbers")
    return values
