"""Run ``vssm-gym study NAME SEQUENCE``: the comparisons of the PRISM paper on any recording."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible
from vssm_gym.cli.shared.lists import aligned, distinct

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
    cells, widths = distinct("voxels", voxels, float), distinct("render-widths", render_widths, int)
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
        for line in aligned([study.header, *lines]):
            say(line)
        say(study.answer)
        say(page)
