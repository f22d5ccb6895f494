"""``vssm-gym study NAME SEQUENCE --out DIR``: the comparisons of the papers, rerun by anyone (SPEC 13)."""

from pathlib import Path
from typing import Annotated

import tyro

SequenceFolder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")]


def map_update(
    sequence: SequenceFolder, out: Path, size: str = "160x120", frames: int = 200, voxel: float = 0.05
) -> None:
    """Compare the closed-form map update with gradient descent through the renderer, at the true poses.

    OUT gets map-update.json, map-update.svg and map-update.html: what held-out images say of the maps, against the
    milliseconds that a frame took (PRISM, fig. 6).

    Args:
        sequence: TUM folder with groundtruth.txt.
        out: folder for the results.
        size: WIDTHxHEIGHT that images are resized to.
        frames: used at most, spread over the sequence; every tenth is held out.
        voxel: size of a cell, metres.
    """
    from vssm_gym.cli.console import progress_bars
    from vssm_gym.cli.slam import _size
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.errors import InputError
    from vssm_gym.eval import study_map_update
    from vssm_gym.eval.destinations import check_at_least, check_folder
    from vssm_gym.eval.studies import write_study

    check_at_least("study", "frames", frames, 20)
    if not 0.0 < voxel <= 0.5:
        raise InputError("study", "voxel", f"a cell size in (0, 0.5] m, found {voxel}")
    check_folder(out)
    recording = load_sequence(sequence)
    with progress_bars() as progress:
        study = study_map_update.run(recording, size=_size(size), frames=frames, voxel=voxel, progress=progress)
    print(study.answer)
    print(write_study(study, out))
