"""List the rows of the table: each runs one filter on simulated runs, built by the functions that its users call."""

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from vssm_gym.agents.shared.own_map import OwnMapConfig
from vssm_gym.data.flights import record_flight
from vssm_gym.data.recording import record_handheld
from vssm_gym.data.sequences import Sequence, load_sequence
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.navigation import Split
from vssm_gym.envs.tasks.reference_flights import HOVER
from vssm_gym.eval.studies.calibration import recordings, replay
from vssm_gym.eval.studies.calibration.cars import car_drives
from vssm_gym.eval.studies.calibration.drives import drives
from vssm_gym.eval.studies.calibration.errors import RunErrors
from vssm_gym.eval.studies.calibration.split import DIVISIONS, seed_of
from vssm_gym.eval.studies.flight import YAWS
from vssm_gym.inference.registry import FILTERS
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.progress import OnProgress
from vssm_gym.slam.map_building import ensure_map
from vssm_gym.slam.options import SlamOptions

NOISES = ("low", "mid", "high")  # levels of the execution noise of robots
WALK_METRES = 8.0  # of a walk with a hand-held camera: about 30 s, turns included
WALK_SEGMENT, DRIVE_SEGMENT, CAR_SEGMENT = 4.0, 5.0, 3.0  # s
MAP_VOXEL, CAR_MAP_VOXEL = 0.05, 0.03  # m, of a learned map that robots and cars track in
# As of ``vssm-gym study flight --imu``
FLIGHT_OPTIONS = SlamOptions(rate=20.0, voxel=0.125, extent=25.0, max_depth=20.0, depth="stereo", imu=True)
FLIGHT_SCENE = "hall"
FLIGHT_SPEEDS = (4.0, 2.0, 3.0)  # m/s, peak
FLIGHT_SEGMENT = HOVER + 4.0  # s
FLIGHT_STARTS = 4  # segments of a run


@dataclass(frozen=True)
class Given:
    """Hold what a row is measured with: the number of runs, the split, the seed, and the study's folder."""

    runs: int
    split: Split
    seed: int
    folder: Path  # maps that are learned for a row are kept there
    on_run: Callable[[int], None]  # called with the number of finished runs
    on_map: OnProgress | None  # called while a map is made


@dataclass(frozen=True)
class Row:
    """Describe a row: its number of runs by default, how it is measured, and what it is, in words."""

    runs: int
    measure: Callable[[Given], list[RunErrors]]
    about: str


def walks(given: Given, *, sensor_noise: str) -> list[RunErrors]:
    """Carry a camera through apartments; PRISM runs as by ``vssm-gym slam`` with its defaults."""
    scenes, options, done = DIVISIONS[given.split].apartments, SlamOptions(), []
    for number in range(given.runs):
        with tempfile.TemporaryDirectory(prefix="vssm-gym-walk-") as folder:
            record_handheld(
                scenes[number % len(scenes)],
                Path(folder) / "walk",
                metres=WALK_METRES,
                rate=options.rate,
                sensor_noise=sensor_noise,
                camera=CameraConfig(*options.size),
                seed=seed_of(given.split, given.seed, number),
            )
            recording = load_sequence(Path(folder) / "walk")
            done.append(recordings.measure(recording, options, recordings.parts(recording, WALK_SEGMENT)))
        given.on_run(len(done))
    return done


def driven(
    given: Given, *, name: str, noise: str, sensor_noise: str = "none", contacts: bool = False
) -> list[RunErrors]:
    """Drive a round robot through apartments; its filter is started as by its agent.

    Args:
        given: number of runs, split and seed.
        name: of the filter.
        noise: level of the execution noise.
        sensor_noise: of the camera.
        contacts: True for drives with contacts alone, False for drives without.
    """
    division, entry, done = DIVISIONS[given.split], FILTERS[name], []
    scenes = division.mapped if entry.needs_map else division.apartments
    driving = drives(
        scenes,
        given.runs,
        noise=noise,
        sensor_noise=sensor_noise,
        split=given.split,
        seed=given.seed,
        contacts=contacts,
    )
    for scene, drive in driving:
        map_of = _map_of(name, scene, given)
        done.append(replay.measure(drive, name, map_of, DRIVE_SEGMENT, only_contacts=contacts))
        given.on_run(len(done))
    return done


def cars(given: Given, *, noise: str) -> list[RunErrors]:
    """Drive a car through arenas; the tracker runs in the learned map, as that of ``vi_mpc_estimated_pose``."""
    done: list[RunErrors] = []
    learned = partial(_learned, given=given, voxel=CAR_MAP_VOXEL)
    arenas = DIVISIONS[given.split].arenas
    driving = car_drives(arenas, given.runs, noise=noise, split=given.split, seed=given.seed, map_of=learned)
    for scene, drive in driving:
        done.append(replay.measure(drive, "tracker", _always(learned(scene)), CAR_SEGMENT))
        given.on_run(len(done))
    return done


def flights(given: Given) -> list[RunErrors]:
    """Fly reference curves through the hall; PRISM runs as by ``vssm-gym slam --depth stereo --imu``.

    The IMU's gravity and bias are measured at rest, so that a filter can start only where a flight does: a flight has
    one segment, its hover at the start and some seconds more. Each run begins its curve some more times for that alone,
    at other speeds and with gusts and readings of their own.
    """
    done: list[RunErrors] = []
    curves = DIVISIONS[given.split].flights
    slowest, fastest = min(FLIGHT_SPEEDS), max(FLIGHT_SPEEDS)
    for number in range(given.runs):
        seeds = [seed_of(given.split, given.seed, FLIGHT_STARTS * number + start) for start in range(FLIGHT_STARTS)]
        curve = curves[number % len(curves)]
        with _flown(curve, FLIGHT_SPEEDS[number // len(curves) % len(FLIGHT_SPEEDS)], seeds[0]) as flight:
            first = recordings.parts(flight, FLIGHT_SEGMENT)[:1]
            run = recordings.measure(flight, FLIGHT_OPTIONS, first)
        ends = list(run.ends)
        for seed in seeds[1:]:
            speed = float(np.random.default_rng(seed).uniform(slowest, fastest))
            with _flown(curve, speed, seed, FLIGHT_SEGMENT) as flight:
                ends.append(recordings.last_nees(recordings.estimate(flight, FLIGHT_OPTIONS)))
        done.append(RunErrors(run.whole, tuple(ends)))
        given.on_run(len(done))
    return done


@contextmanager
def _flown(flight: str, speed: float, seed: int, seconds: float | None = None) -> Iterator[Sequence]:
    """Fly a curve for some seconds, or all of it."""
    with tempfile.TemporaryDirectory(prefix="vssm-gym-flight-") as folder:
        record_flight(
            FLIGHT_SCENE,
            Path(folder) / "flight",
            flight=flight,
            speed=speed,
            yaw=YAWS[flight],
            rate=FLIGHT_OPTIONS.rate,
            seconds=seconds,
            sensor_noise="stereo",
            camera=CameraConfig(*FLIGHT_OPTIONS.size),
            seed=seed,
        )
        yield load_sequence(Path(folder) / "flight")


def _map_of(name: str, scene: str, given: Given) -> replay.MapOf:
    """Return the map that a filter starts with: the learned one of a scene, an explorer's empty one, or none."""
    entry = FILTERS[name]
    if entry.needs_map:
        return _always(_learned(scene, given, MAP_VOXEL))
    own = OwnMapConfig()
    return lambda context: own.empty_map(context.start_pose) if entry.maps else None


def _always(voxel_map: VoxelMap) -> replay.MapOf:
    return lambda context: voxel_map


def _learned(scene: str, given: Given, voxel: float) -> VoxelMap:
    """Return the map of a scene as a sweep learns it; it is made once and kept in the study's folder."""
    path = ensure_map(scene, given.folder, voxel=voxel, seed=given.seed, on_progress=given.on_map)
    return _loaded(path)


@lru_cache(maxsize=1)
def _loaded(path: Path) -> VoxelMap:
    return VoxelMap.load(path)


ROWS: dict[str, Row] = {
    "hand-held-exact": Row(
        12, partial(walks, sensor_noise="none"), "PRISM with the defaults of `vssm-gym slam`, a camera without noise"
    ),
    "hand-held-kinect": Row(
        12, partial(walks, sensor_noise="kinect"), "the same with the noise of a Kinect, depth and colour"
    ),
}
for _noise in NOISES:
    for _sensor, _depth in (("none", "exact"), ("kinect", "kinect")):
        ROWS[f"planar-{_noise}-{_depth}"] = Row(
            20,
            partial(driven, name="prism", noise=_noise, sensor_noise=_sensor),
            f"PRISM of an explorer that estimates its pose, execution noise {_noise}, without contacts",
        )
ROWS["planar-contacts"] = Row(
    20,
    partial(driven, name="prism", noise="mid", contacts=True),
    "the same, noise mid, drives into obstacles; segments with a contact alone",
)
for _noise in NOISES:
    ROWS[f"known-map-{_noise}"] = Row(
        20, partial(driven, name="tracker", noise=_noise), f"the tracker in a learned map, of `astar`, noise {_noise}"
    )
for _noise in NOISES:
    ROWS[f"previous-image-{_noise}"] = Row(
        20, partial(driven, name="frames", noise=_noise), f"alignment to the image before, of `no_map`, noise {_noise}"
    )
for _noise in NOISES:
    ROWS[f"dead-reckoning-{_noise}"] = Row(
        20, partial(driven, name="dead_reckoning", noise=_noise), f"integrated commands, noise {_noise}"
    )
for _noise in NOISES:
    ROWS[f"car-{_noise}"] = Row(
        20, partial(cars, noise=_noise), f"the tracker in a learned map with the motion of a car, noise {_noise}"
    )
ROWS["flight-imu"] = Row(12, flights, "PRISM with an IMU's motion, stereo depth, flights of 2 to 4 m/s through a hall")
