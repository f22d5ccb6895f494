"""Run ``vssm-gym merge SHARD ... --out DIR``: merge the shards of a sweep."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import say


def merge(
    folders: Annotated[
        tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="SHARD [SHARD ...]", help_behavior_hint="")
    ],
    out: Path,
) -> None:
    """Merge the folders of `sweep --shard I/N` into the folder of the whole sweep.

    Every shard must be given and finished; otherwise nothing is written.

    Args:
        folders: the folders of all shards, in any order.
        out: new or empty folder.
    """

    from vssm_gym.cli.shared.console import print_results
    from vssm_gym.eval.sweep.merge import merge_sweeps

    merged = merge_sweeps(folders, out)
    print_results(merged.log)
    for notice in merged.notices:
        say(f"warning: {notice}", error=True)
    say(f"episodes: {merged.log}", f"next: vssm-gym report {out}")
