"""``vssm-gym map build SEQUENCE --out map.npz``: learn a map from a recording (DESIGN)."""

from pathlib import Path
from typing import Annotated

import tyro


def build(
    sequence: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")], out: Path, voxel: float = 0.05
) -> None:
    """Build a map in closed form from a recorded sequence at its ground-truth poses.

    Args:
        sequence: TUM folder with groundtruth.txt; `vssm-gym record` makes one.
        out: the map file to write (.npz).
        voxel: size of a cell, metres.
    """
    from vssm_gym.cli.console import progress_bars
    from vssm_gym.cli.slam import print_warnings
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.errors import InputError
    from vssm_gym.eval.destinations import check_file
    from vssm_gym.eval.maps import build_map

    if not 0.0 < voxel <= 0.5:
        raise InputError("map build", "voxel", f"a cell size in (0, 0.5] m, found {voxel}")
    check_file(out)
    recording = load_sequence(sequence)
    print_warnings(recording.notices)
    damaged: list[str] = []
    with progress_bars() as progress:
        voxel_map = build_map(recording, voxel, progress, damaged.extend)
    print_warnings(damaged)
    voxel_map.save(out)
    size = " x ".join(f"{n * voxel:.1f}" for n in voxel_map.shape)
    print(f"{size} m in cells of {voxel} m: {out}")
