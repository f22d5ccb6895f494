"""Recognise a log by what is on disk, and read it."""

from pathlib import Path

from vssm_gym.data.dynamics.blackbird import read_blackbird
from vssm_gym.data.dynamics.euroc import IMU_FILES, find, read_euroc
from vssm_gym.data.dynamics.log import DynamicsLog
from vssm_gym.data.dynamics.recordings import read_recording
from vssm_gym.errors import InputError
from vssm_gym.files.bounded import is_file

HDF5 = (".hdf5", ".h5")  # endings of such files
INDEXES = ("rgb.txt", "associations.txt", "groundtruth.txt")  # one of which a recording has at least


def read_dynamics(path: str | Path) -> DynamicsLog:
    """Read a Blackbird flight (HDF5 file), a EuRoC flight (folder of csv files) or one of our recordings (TUM folder).

    Raises:
        InputError: none of the three, or a damaged one.
    """
    path = Path(path)
    if path.suffix.lower() in HDF5:
        return read_blackbird(path)
    if path.is_dir() and find(path, IMU_FILES):
        return read_euroc(path)
    if any((path / name).exists() for name in INDEXES):
        return read_recording(path)
    found = "this is another folder" if path.is_dir() else "this is another file" if is_file(path) else "there is none"
    expected = "a Blackbird flight (.hdf5), a folder with EuRoC's csv files, or a recording (TUM folder)"
    raise InputError(path, "file", f"{expected}; {found}")
