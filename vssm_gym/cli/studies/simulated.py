"""Run ``vssm-gym study NAME``: maps, flights and smoothing in the simulated apartments."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible
from vssm_gym.cli.shared.lists import aligned, distinct, names_in


@interruptible("map-reliability.json")
def map_reliability(
    out: Path,
    split: Literal["train", "test"] = "train",
    maps: int | None = None,
    voxel: float = 0.05,
    seed: int = 0,
    resume: bool = False,
) -> None:
    """Compare the error of learned maps' surfaces with the standard deviation that they state.

    OUT gets map-reliability.json, map-reliability.svg and map-reliability.html: bins of the stated deviation against
    the error, with true and estimated poses, exact depth and a Kinect's. They are written anew after every row.

    Args:
        out: folder for the results.
        split: apartments and seeds to tune on (train) or to judge on (test).
        maps: maps of each row; by default one of each apartment.
        voxel: edge of a cell, metres.
        seed: of the drives.
        resume: continue in OUT with the rows that are missing.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies.map_reliability import study as reliability_study
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_folder

    setting = reliability_study.Setting(split, seed, maps, voxel)
    check_folder(out)
    with study_folder("map-reliability", out, resume):
        done = reliability_study.finished(out / "map-reliability.json", setting) if resume else {}
        with progress_bars() as progress:
            for study in reliability_study.run(setting, done=done, on_progress=progress):
                page = write_study(study, out)
        for line in aligned([study.header, *study.lines]):
            say(line)
        say(study.answer)
        say(page)


@interruptible()
def flight(
    out: Path,
    scene: str = "hall",
    flights: str = "star,picasso,figure8",
    speeds: str = "1,2,3,4",
    sensor_noise: str = "stereo",
    size: str = "160x120",
    rate: float = 20.0,
    voxel: float = 0.125,
    extent: float = 25.0,
    max_depth: float = 20.0,
    imu: bool = False,
    seeds: int = 1,
) -> None:
    """Fly reference flights through a hall at several speeds, and track them from noisy stereo images.

    OUT gets flight.json, flight.svg and flight.html: trajectory error, lost frames and milliseconds per step of every
    flight (PRISM, table 1).

    Args:
        out: folder for the results.
        scene: built-in name or path of a scene file.
        flights: star, picasso, figure8, clover, separated by commas.
        speeds: peak speeds, m/s, separated by commas.
        sensor_noise: noise of the camera: none, kinect or stereo.
        size: WIDTHxHEIGHT of the images.
        rate: images per second.
        voxel: edge of a cell, metres.
        extent: edge of the cube that is mapped around the first camera, metres.
        max_depth: metres; readings beyond it are ignored.
        imu: predict the motion from the IMU instead of a constant velocity.
        seeds: flights of each kind, each with its own gusts and noise.
    """
    from vssm_gym.cli.shared.arguments import parse_size
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies import flight as study_flight
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_at_least, check_folder
    from vssm_gym.slam.options import SlamOptions

    check_at_least("study", "seeds", seeds, 1)
    options = SlamOptions(
        size=parse_size("study", size),
        rate=rate,
        voxel=voxel,
        extent=extent,
        max_depth=max_depth,
        depth="stereo",
        imu=imu,
    )
    check_folder(out)
    names = names_in(flights)
    with study_folder("flight", out):
        with progress_bars() as progress:
            study = study_flight.run(
                scene,
                flights=names,
                speeds=distinct("speeds", speeds, float),
                sensor_noise=sensor_noise,
                options=options,
                seeds=seeds,
                on_progress=progress,
            )
        say(study.answer)
        say(write_study(study, out))


@interruptible("smoothing.json")
def smoothing(
    sequences: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE ...")] = (),
    *,
    out: Path,
    walks: int = 8,
    flights: int = 16,
    split: Literal["train", "test"] = "train",
    rate: float = 10.0,
    depth: str = "good",
    seed: int = 0,
    resume: bool = False,
) -> None:
    """Compare the smoother of ``slam --refine`` with the filter that it starts from.

    OUT gets smoothing.json, smoothing.svg and smoothing.html, one row for each recording: trajectory error, NEES over
    the dimension, errors of the maps in images that were held out, and times. They are written anew after every row.

    Args:
        sequences: TUM folders with groundtruth.txt.
        out: folder for the results.
        walks: simulated walks with a Kinect through apartments.
        flights: simulated flights with a stereo camera through a hall, at 1 to 4 m/s.
        split: scenes and seeds to tune on (train) or to judge on (test).
        rate: frames per second at most, of the given sequences; images in between judge the maps.
        depth: what measured the depth of the given sequences: good or stereo.
        seed: of the simulated recordings.
        resume: continue in OUT with the rows that are missing.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.eval.studies.smoothing import study as smoothing_study
    from vssm_gym.files.output_folders import check_folder

    setting = smoothing_study.Setting(split, seed, walks, flights, rate, depth)
    recordings = smoothing_study.checked([load_sequence(sequence) for sequence in sequences], setting)
    check_folder(out)
    with study_folder("smoothing", out, resume):
        done = smoothing_study.finished(out / "smoothing.json", setting) if resume else {}
        with progress_bars() as progress:
            for study in smoothing_study.run(recordings, setting, done=done, on_progress=progress):
                page = write_study(study, out)
        for line in aligned([study.header, *study.lines]):
            say(line)
        say(study.answer)
        say(page)
