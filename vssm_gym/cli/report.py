"""Run ``vssm-gym report DIR``: write the results of a sweep as one HTML page."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import say


def report(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    seed: int = 0,
) -> None:
    """Write DIR/report.html: failures first, tables with 95 % intervals, curves, and runs drawn on a map.

    Args:
        folder: folder of a sweep, finished or not.
        out: file to write in place of DIR/report.html (.html); its folder must exist.
        seed: seed of the bootstrap resampling behind the intervals.
    """
    from vssm_gym.eval.report.page import write_report

    say(write_report(folder, seed, out))
