"""Run ``vssm-gym study NAME SEQUENCE --out DIR``: the comparisons of the PRISM paper on any recording."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible

Number = TypeVar("Number", int, float)
SequenceFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")]


@interruptible()
def map_update(
    sequence: SequenceFolder, out: Path, size: str = "160x120", frames: int = 200, voxel: float = 0.05
) -> None:
    """Compare the closed-form map update with gradient descent through the renderer, at the true poses.

    OUT gets map-update.json, map-update.svg and map-update.html: the errors of the maps in held-out images, against the
    time per frame (PRISM, fig. 6).

    Args:
        sequence: TUM folder with groundtruth.txt.
        out: folder for the results.
        size: WIDTHxHEIGHT to which images are resized.
        frames: maximum number of frames, spread over the sequence; every tenth is held out.
        voxel: edge of a cell, metres.
    """
    from vssm_gym.cli.shared.arguments import parse_size
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.errors import InputError
    from vssm_gym.eval.studies import map_update as study_map_update
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("study", "frames", frames, 20)
    if not 0.0 < voxel <= 0.5:
        raise InputError("study", "voxel", f"a cell size in (0, 0.5] m, found {voxel}")
    check_folder(out)
    recording = load_sequence(sequence)
    with study_folder("map-update", out):
        with progress_bars() as progress:
            study = study_map_update.run(
                recording, size=parse_size("study", size), frames=frames, voxel=voxel, on_progress=progress
            )
        say(study.answer)
        say(write_study(study, out))


@interruptible()
def resolution(
    sequence: SequenceFolder,
    out: Path,
    voxels: str = "0.04,0.07,0.10",
    render_widths: str = "80,160",
    seeds: int = 3,
    size: str = "160x120",
    rate: float = 10.0,
) -> None:
    """Compare resolutions of the map and of the tracked images, by error and time.

    OUT gets resolution.json, resolution.svg and resolution.html: trajectory error, lost frames and time per step
    (PRISM, table 4).

    Args:
        sequence: TUM folder with groundtruth.txt.
        out: folder for the results.
        voxels: edges of a cell, metres, separated by commas.
        render_widths: widths of the tracked images, pixels, separated by commas.
        seeds: runs of each setting; each starts one frame later than the one before.
        size: WIDTHxHEIGHT to which images are resized.
        rate: frames per second at most.
    """
    from vssm_gym.cli.shared.arguments import parse_size
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.eval.studies import resolution as study_resolution
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("study", "seeds", seeds, 1)
    cells, widths = _distinct("voxels", voxels, float), _distinct("render-widths", render_widths, int)
    check_folder(out)
    recording = load_sequence(sequence)
    with study_folder("resolution", out):
        with progress_bars() as progress:
            study = study_resolution.run(
                recording,
                voxels=cells,
                render_widths=widths,
                size=parse_size("study", size),
                rate=rate,
                seeds=seeds,
                on_progress=progress,
            )
        say(study.answer)
        say(write_study(study, out))


@interruptible()
def runtime(sequence: SequenceFolder, out: Path, rate: float = 10.0) -> None:
    """Break down the time of a step into its stages, at several image sizes, cell sizes and extents of the map.

    OUT gets runtime.json, runtime.svg and runtime.html: median and 95th percentile of every stage (PRISM, fig. 5).

    Args:
        sequence: TUM folder; the size of its images is the largest size measured.
        out: folder for the results.
        rate: frames per second at most.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.eval.studies import runtime as study_runtime
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_folder

    check_folder(out)
    recording = load_sequence(sequence)
    with study_folder("runtime", out):
        with progress_bars() as progress:
            study = study_runtime.run(recording, rate=rate, on_progress=progress)
        say(study.answer)
        say(write_study(study, out))


@interruptible("calibration.json")
def calibration(
    sequences: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE ...")] = (),
    *,
    out: Path,
    rows: str = "*",
    runs: int | None = None,
    split: Literal["train", "test"] = "train",
    seed: int = 0,
    resume: bool = False,
) -> None:
    """Measure how right the covariance of every filter is, in simulation and on recordings with ground truth.

    OUT gets calibration.json, calibration.svg and calibration.html, one row for each filter and condition: NEES over
    the dimension, share of poses inside their 95 % region, error and stated deviation of the location (PRISM, figs. 7
    and 8). They are written anew after every row, and learned maps are kept in OUT.

    Args:
        sequences: TUM folders with groundtruth.txt; each gives rows of its own.
        out: folder for the results.
        rows: names of simulated rows, or patterns as planar-*, separated by commas; empty for none.
        runs: runs of each simulated row; by default each row's own number.
        split: scenes and seeds to tune on (train) or to judge on (test).
        seed: of the simulated runs.
        resume: continue in OUT with the rows that are missing.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.eval.studies.calibration import study as calibration_study
    from vssm_gym.eval.studies.calibration.stored import finished
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_folder

    setting = calibration_study.Setting(split, seed, runs)
    names = calibration_study.chosen(rows)
    recordings = calibration_study.checked([load_sequence(sequence) for sequence in sequences], names)
    check_folder(out)
    with study_folder("calibration", out, resume):
        done = finished(out / "calibration.json", asdict(setting)) if resume else {}
        page: Path | None = None
        lines: Sequence[Sequence[str]] = []
        with progress_bars() as progress:
            for study in calibration_study.run(recordings, names, setting, folder=out, done=done, on_progress=progress):
                page, lines = write_study(study, out), study.lines
        for line in _aligned([study.header, *lines]):
            say(line)
        say(study.answer)
        say(page)


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
        for line in _aligned([study.header, *study.lines]):
            say(line)
        say(study.answer)
        say(page)


def _aligned(lines: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table with columns of one width, the first to the left and the others to the right."""
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    return [
        "  ".join([line[0].ljust(widths[0]), *(cell.rjust(w) for cell, w in zip(line[1:], widths[1:], strict=True))])
        for line in lines
    ]


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
    names = _names(flights)
    with study_folder("flight", out):
        with progress_bars() as progress:
            study = study_flight.run(
                scene,
                flights=names,
                speeds=_distinct("speeds", speeds, float),
                sensor_noise=sensor_noise,
                options=options,
                seeds=seeds,
                on_progress=progress,
            )
        say(study.answer)
        say(write_study(study, out))


def _distinct(field: str, text: str, kind: Callable[[str], Number]) -> tuple[Number, ...]:
    """Return the numbers of a list with commas between them, each once, in their order."""
    from vssm_gym.cli.shared.arguments import parse_numbers

    return tuple(dict.fromkeys(parse_numbers("study", field, text, kind, "numbers with commas between")))


def _names(text: str) -> tuple[str, ...]:
    """Return the names of a list with commas between them, each once, in their order."""
    return tuple(dict.fromkeys(text.replace(" ", "").split(",")))


@interruptible()
def relocalisation(
    out: Path,
    scenes: str = "fern,ivy,moss,reed",
    sensor_noise: str = "none,kinect",
    poses: int = 100,
    maps: Path | None = None,
    seed: int = 0,
) -> None:
    """Look for a robot at random poses of several scenes, in their learned maps, without any prior.

    OUT gets relocalisation.json, relocalisation.svg and relocalisation.html: shares of the images that are found,
    ambiguous, or accepted at a wrong place, with errors and times; and the maps, which are kept and used again.

    Args:
        out: folder for the results.
        scenes: built-in names or paths, separated by commas.
        sensor_noise: noises of the camera: none, kinect or stereo, separated by commas.
        poses: images of each scene with each noise.
        maps: folder of the learned maps, such as a sweep's; OUT by default.
        seed: of poses, noise and the drives that the maps are learned from.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies import relocalisation as study_relocalisation
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("study", "poses", poses, 1)
    check_folder(out)
    with study_folder("relocalisation", out):
        with progress_bars() as progress:
            study = study_relocalisation.run(
                _names(scenes),
                maps or out,
                sensors=_names(sensor_noise),
                poses=poses,
                seed=seed,
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
        for line in _aligned([study.header, *study.lines]):
            say(line)
        say(study.answer)
        say(page)


@interruptible()
def pose_flow(out: Path, seed: int = 0) -> None:
    """Fit Gaussians and a normalising flow to the pose of a camera that sees a ball and cannot tell from which side.

    OUT gets pose-flow.json, pose-flow.svg and pose-flow.html: the evidence lower bound of each family, and how much of
    the sphere of poses it covers.

    Args:
        out: folder for the results.
        seed: of the image's noise and of the fits.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.eval.studies.pose_flow import study as study_pose_flow
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("study", "seed", seed, 0)
    check_folder(out)
    with study_folder("pose-flow", out):
        with progress_bars() as progress:
            study = study_pose_flow.run(seed, on_progress=progress)
        for line in _aligned([study.header, *study.lines]):
            say(line)
        say(study.answer)
        say(write_study(study, out))


@interruptible()
def pose_ambiguity(
    out: Path, maze: str = "serpentine-v1", scans: int = 120, particles: int = 20_000, seed: int = 0
) -> None:
    """Localise a robot in a known maze from nowhere, and count the places where it could be after each scan.

    OUT gets pose-ambiguity.json, pose-ambiguity.svg and pose-ambiguity.html: the particles in the map at several times,
    number of places, entropy, and mass at the true pose (DVBF-LM, fig. 1).

    Args:
        out: folder for the results.
        maze: name of a maze.
        scans: of the drive.
        particles: of the filter.
        seed: of the drives and of the filter.
    """
    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.eval.studies.pose_ambiguity import study as study_pose_ambiguity
    from vssm_gym.files.output_folders import check_at_least, check_folder

    check_at_least("study", "seed", seed, 0)
    check_at_least("study", "scans", scans, 2)
    check_at_least("study", "particles", particles, 10)
    check_folder(out)
    with study_folder("pose-ambiguity", out):
        with progress_bars() as progress:
            study = study_pose_ambiguity.run(maze, scans, particles, seed, on_progress=progress)
        for line in _aligned([study.header, *study.lines]):
            say(line)
        say(study.answer)
        say(write_study(study, out))


@interruptible("maze-exploration.jsonl")
def maze_exploration(
    out: Path,
    mazes: str = "",
    explorers: str = "",
    seeds: int = 7,
    steps: int = 1000,
    noise: str = "low",
    sensor_noise: str = "low",
    resume: bool = False,
) -> None:
    """Compare explorers of LidarMaze's mazes: information of sampled scans, frontiers, trained policies, chance.

    OUT gets maze-exploration.json, maze-exploration.svg and maze-exploration.html, and a row for each run in
    maze-exploration.jsonl: tiles visited and nats gained, every 20 steps.

    Args:
        out: folder for the results.
        mazes: names, separated by commas; all by default.
        explorers: names, separated by commas; all by default.
        seeds: starts and noises in each maze.
        steps: of a run.
        noise: of the execution: none, low, mid or high.
        sensor_noise: of the ranges: none, low, mid or high.
        resume: continue in OUT with the runs that are missing.
    """
    from dataclasses import asdict

    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.studies.maze_exploration.comparison import study as compare
    from vssm_gym.eval.studies.maze_exploration.run import EXPLORATION_ROWS, ExplorationSetting, run
    from vssm_gym.eval.studies.page import study_folder, write_study
    from vssm_gym.files.output_folders import check_folder, check_new_file

    chosen = {name: _names(text) for name, text in (("mazes", mazes), ("explorers", explorers)) if text}
    setting = ExplorationSetting(**chosen, seeds=seeds, steps=steps, noise=noise, sensor_noise=sensor_noise)
    check_folder(out)
    with study_folder("maze-exploration", out, resume):
        if not resume:
            check_new_file(out / EXPLORATION_ROWS)
        with progress_bars() as progress:
            found = compare(run(setting, out, progress), asdict(setting))
        for line in _aligned([found.header, *found.lines]):
            say(line)
        say(found.answer)
        say(write_study(found, out))
