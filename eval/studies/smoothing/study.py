"""Measure filter and smoother on walks, flights and given recordings; every finished one gives a complete study."""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from vssm_gym.data.flights import record_flight
from vssm_gym.data.recording import record_handheld
from vssm_gym.data.sequences import Sequence, load_sequence
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.navigation import Split
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.studies.calibration.rows import FLIGHT_OPTIONS, FLIGHT_SCENE
from vssm_gym.eval.studies.calibration.split import DIVISIONS, seed_of
from vssm_gym.eval.studies.flight import YAWS
from vssm_gym.eval.studies.page import Study, labelled
from vssm_gym.eval.studies.smoothing.comparison import SOURCE, compare
from vssm_gym.eval.studies.smoothing.table import StoredRow, study_of
from vssm_gym.eval.studies.stored_rows import stored_rows
from vssm_gym.progress import OnProgress
from vssm_gym.slam.options import SlamOptions

SMOOTHED_METRES = 15.0  # of a walk: about a minute, turns included
SPEEDS = (1.0, 2.0, 3.0, 4.0)  # m/s, peak, of flights in turn
WALK_OPTIONS = SlamOptions()
# As of `study flight`: without its IMU
STEREO_OPTIONS = replace(FLIGHT_OPTIONS, imu=False)
FASTER = 2.0  # images are recorded so many times as fast as the filter takes them: the others judge the maps


@dataclass(frozen=True)
class Setting:
    """Hold what decides the numbers of a recording; a study that is continued keeps it."""

    split: Split = "train"
    seed: int = 0
    walks: int = 8
    flights: int = 16
    rate: float = 10.0  # frames a second at most, of given recordings
    depth: str = "good"  # what measured theirs: a key of DEPTHS

    @property
    def options(self) -> SlamOptions:
        """Return the options of the filter for given recordings."""
        return SlamOptions(rate=self.rate, depth=self.depth)

    def __post_init__(self) -> None:
        if self.split not in DIVISIONS:
            raise InputError(SOURCE, "split", one_of(DIVISIONS, self.split))
        if not 0 <= self.seed < 2**31:
            raise InputError(SOURCE, "seed", f"between 0 and 2^31 - 1; found {self.seed}")
        for name in ("walks", "flights"):
            if not 0 <= getattr(self, name) <= 1000:
                raise InputError(SOURCE, name, f"between 0 and 1000; found {getattr(self, name)}")
        _ = self.options  # checks rate and depth


def checked(recordings: list[Sequence], setting: Setting) -> list[Sequence]:
    """Return the recordings, each with ground truth at every frame and a name of its own.

    Raises:
        InputError: one without such ground truth, two of one name, or nothing to measure at all.
    """
    if not recordings and not setting.walks and not setting.flights:
        raise InputError(SOURCE, "walks", "walks, flights or recordings; found none")
    names = [one.root.resolve().name for one in recordings]
    for one, name in zip(recordings, names, strict=True):
        if one.truth is None:
            raise InputError(one.root / "groundtruth.txt", "file", "ground-truth poses, which this study needs")
        one.true_poses()  # one at every frame, said before hours of work
        if names.count(name) > 1:
            raise InputError(SOURCE, "sequences", f"folders with different names; found {name!r} twice")
    return recordings


def run(
    recordings: list[Sequence],
    setting: Setting,
    *,
    done: Mapping[str, Any],
    on_progress: OnProgress | None = None,
) -> Iterator[Study]:
    """Measure recording after recording, and yield the study of all so far after each.

    Args:
        recordings: given ones, with ground truth.
        setting: split, seed and numbers of simulated ones; options of the filter for given ones.
        done: rows that are not measured again.
        on_progress: called with (recording, steps done, steps).

    Raises:
        InputError: a recording without ground truth.
    """
    simulated = simulated_recordings(setting)
    given = {one.root.resolve().name: one for one in recordings}
    rows, stated = dict(done), asdict(setting)
    names = [*simulated, *given]
    in_order = lambda: {name: rows[name] for name in [*names, *rows] if name in rows}
    for name in names:
        if name in rows:
            continue
        show = labelled(on_progress, name)
        if name in given:
            rows[name] = compare(given[name], setting.options, show)
        else:
            rows[name] = measure_simulated(simulated[name], show)
        yield study_of(in_order(), stated)
    if rows.keys() == done.keys():
        yield study_of(in_order(), stated)


def finished(path: Path, setting: Setting) -> dict[str, dict[str, Any]]:
    """Return the rows of an outcome that is continued; see :func:`~vssm_gym.eval.studies.stored_rows.stored_rows`."""
    return stored_rows(path, asdict(setting), StoredRow, "the outcome of a study of the smoother")


def measure_simulated(record: Callable[[Path], SlamOptions], on_progress: OnProgress | None = None) -> dict[str, Any]:
    """Record one of :func:`simulated_recordings` into a temporary folder and measure filter and smoother on it."""
    with tempfile.TemporaryDirectory(prefix="vssm-gym-smoothing-") as folder:
        options = record(Path(folder) / "recording")
        return compare(load_sequence(Path(folder) / "recording"), options, on_progress)


def simulated_recordings(setting: Setting) -> dict[str, Callable[[Path], SlamOptions]]:
    """Return by name what records each simulated recording, and the options that the filter then gets."""
    division = DIVISIONS[setting.split]
    found: dict[str, Callable[[Path], SlamOptions]] = {}
    for number in range(setting.walks):
        scene, seed = division.apartments[number % len(division.apartments)], _seed(setting, number)
        found[f"walk {number}, {scene}"] = partial(_walk, scene=scene, seed=seed)
    for number in range(setting.flights):
        curve, seed = division.flights[number % len(division.flights)], _seed(setting, number)
        speed = SPEEDS[number // len(division.flights) % len(SPEEDS)]
        found[f"flight {number}, {curve} {speed:g} m/s"] = partial(_flight, curve=curve, speed=speed, seed=seed)
    return found


def _seed(setting: Setting, number: int) -> int:
    return seed_of(setting.split, setting.seed, number)


def _walk(out: Path, scene: str, seed: int) -> SlamOptions:
    """Carry a Kinect through an apartment."""
    record_handheld(
        scene,
        out,
        metres=SMOOTHED_METRES,
        rate=FASTER * WALK_OPTIONS.rate,
        sensor_noise="kinect",
        camera=CameraConfig(*WALK_OPTIONS.size),
        seed=seed,
    )
    return WALK_OPTIONS


def _flight(out: Path, curve: str, speed: float, seed: int) -> SlamOptions:
    """Fly a curve through the hall with a stereo camera."""
    record_flight(
        FLIGHT_SCENE,
        out,
        flight=curve,
        speed=speed,
        yaw=YAWS[curve],
        rate=FASTER * STEREO_OPTIONS.rate,
        sensor_noise="stereo",
        camera=CameraConfig(*STEREO_OPTIONS.size),
        seed=seed,
    )
    return STEREO_OPTIONS
