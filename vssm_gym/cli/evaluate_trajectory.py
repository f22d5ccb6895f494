"""Run ``vssm-gym evaluate-trajectory EST TRUE``: absolute and relative error of an estimated trajectory."""

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from vssm_gym.cli.shared.console import literal_console

if TYPE_CHECKING:
    from rich.table import Table

ALIGNMENTS = {"se3": "SE(3)", "sim3": "Sim(3)", "first": "of the first pose", "none": "none"}
SHOWN = ("rmse", "mean", "median", "min", "max")


def evaluate_trajectory(
    estimate: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="EST")],
    truth: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TRUE")],
    alignment: Annotated[Literal["se3", "sim3", "first", "none"], tyro.conf.arg(name="align")] = "se3",
    tolerance: float = 0.01,
    json_file: Annotated[Path | None, tyro.conf.arg(name="json", metavar="FILE")] = None,
) -> None:
    """Compute the absolute (ATE) and relative (RPE) trajectory error of an estimate, after a stated alignment.

    Args:
        estimate: trajectory as TUM text (time tx ty tz qx qy qz qw, one line per pose) or EuRoC csv.
        truth: the true trajectory, in either format.
        alignment: se3: the rigid motion of least squared error; sim3: the similarity, for monocular estimates, whose
            scale is unknown (the relative errors are then those of the scaled estimate); first: the first pair of
            poses, so that the error is the drift since then; none: both files share one frame.
        tolerance: largest difference between the stamps of a pair of poses, seconds.
        json_file: also write every statistic to this file (.json).
    """

    from vssm_gym.data.trajectories import read_trajectory
    from vssm_gym.errors import InputError
    from vssm_gym.files.atomic import atomic_write
    from vssm_gym.files.output_folders import check_file
    from vssm_gym.slam.trajectory_error import align, associate, evaluate

    if not tolerance >= 0.0:
        raise InputError("evaluate-trajectory", "tolerance", f"seconds >= 0, not {tolerance}")
    if json_file is not None:
        check_file(json_file, (".json",), inputs=(estimate, truth))
    times_est, T_est = read_trajectory(estimate)
    times_true, T_true = read_trajectory(truth)
    of_est, of_true = associate(times_est, times_true, tolerance)
    if len(of_est) == 0:
        raise InputError(estimate, "times", f"a stamp within {tolerance} s of one in {truth}")
    stated, scale = ALIGNMENTS[alignment], 1.0
    if alignment == "sim3":
        similarity = align(T_est[of_est, :3, 3], T_true[of_true, :3, 3], with_scale=True)
        T_est, scale = similarity.apply(T_est), similarity.scale
        stated = f"{stated} with scale {scale:.6f}"
    result = evaluate(times_est, T_est, times_true, T_true, tolerance, alignments=(alignment,))
    if json_file is not None:
        if alignment == "sim3":
            result["scale"] = scale  # of the estimate as it was read
        content = {"estimate": str(estimate), "truth": str(truth), "alignment": stated, **result}
        with atomic_write(json_file) as temporary:
            temporary.write_text(json.dumps(content, indent=2) + "\n")
    console = literal_console(soft_wrap=True)
    console.print(
        f"{result['pairs']} pairs of {len(times_est)} estimated and {len(times_true)} true poses, "
        f"stamps within {tolerance:g} s, alignment {stated}"
    )
    console.print(_table(result, alignment))


def _table(result: dict[str, Any], alignment: str) -> "Table":
    """Return the table: one row for each kind of error, with name, unit and :data:`SHOWN`."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("error", no_wrap=True)
    table.add_column("unit", no_wrap=True)
    for statistic in SHOWN:
        table.add_column(statistic, justify="right", no_wrap=True, overflow="ignore")
    rows = [("ATE position", "m", f"ate_translation_{alignment}"), ("ATE rotation", "deg", f"ate_rotation_{alignment}")]
    for name in result:
        if match := re.fullmatch(r"rpe_(translation|rotation)_(\d+)", name):
            kind, unit = ("position", "m") if match[1] == "translation" else ("rotation", "deg")
            rows.append((f"RPE {kind}, {match[2]} frame{'s' * (match[2] != '1')}", unit, name))
    for label, unit, name in rows:
        table.add_row(label, unit, *(f"{result[name][statistic]:.6f}" for statistic in SHOWN))
    return table
