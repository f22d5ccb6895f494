"""Run ``vssm-gym faults NAME``: give faulty images to what uses images, and fail where it believes them."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import literal_console, say
from vssm_gym.cli.shared.interruption import interruptible

FAULTS_FAILED = 1  # exit code: a fault was missed, or believed


@interruptible()
def slam(
    sequences: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SEQUENCE ...]")] = (),
    out: Path = Path("out/faults"),
    seed: int = 0,
) -> int:
    """Run SLAM on simulated walks and on recordings whose camera fails for a while or is carried off.

    Prints when each fault was flagged, and the largest error of a pose that was accepted; OUT gets slam.json. The exit
    code is 1 where a fault was missed or a wrong pose was accepted.

    Args:
        sequences: further TUM folders with groundtruth.txt; their second halves are used.
        out: folder for the results.
        seed: seed of the walks and of the faults.
    """
    import json

    from rich.table import Table

    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.data.sequences import load_sequence
    from vssm_gym.eval.faults import slam as faulty_slam
    from vssm_gym.files.atomic import atomic_write
    from vssm_gym.files.output_folders import Owner, check_at_least, check_folder, owned_folder
    from vssm_gym.version import package_version

    check_at_least("faults", "seed", seed, 0)
    check_folder(out)
    recordings = [load_sequence(sequence) for sequence in sequences]
    with owned_folder(out, Owner("faults", "faults.json", {"version": package_version()}, identity=())):
        with progress_bars() as progress:
            rows = faulty_slam.run(recordings, seed=seed, on_progress=progress)
        stored = {"version": package_version(), "seed": seed} | faulty_slam.figures(rows)
        with atomic_write(out / "slam.json") as temporary:
            temporary.write_text(json.dumps(stored, indent=1) + "\n")
    table = Table(title="SLAM with faults", caption="error: of the worst accepted position since the fault began")
    for name in ("fault", "where", "flagged after", "error, cm", "stds", "back after", "outcome"):
        table.add_column(name, justify="left" if name in ("fault", "where", "outcome") else "right", no_wrap=True)
    for row in rows:
        flagged, back = ("-" if n is None else str(n) for n in (row.flagged, row.back))
        believed = f"{row.wrong} wrong poses accepted" if row.wrong else ""
        outcome = "passed" if row.passed else ", ".join(filter(None, ("missed" if row.missed else "", believed)))
        errors = (f"{100 * row.error_m:.1f}", f"{row.error_stds:.1f}") if row.confident else ("-", "-")
        table.add_row(row.fault, row.place, flagged, *errors, back, outcome)
    literal_console().print(table)
    failed = sum(not row.passed for row in rows)
    say(f"{len(rows) - failed} of {len(rows)} runs passed; {out / 'slam.json'}")
    return FAULTS_FAILED if failed else 0


@interruptible("maps/*.npz")
def navigation(out: Path = Path("out/faults"), seed: int = 0) -> int:
    """Run agents that estimate their pose with a camera that fails for a while, or carry them off.

    Prints when each fault was flagged and what the agent said at the end; OUT gets navigation.json, and the maps of the
    scenes. The exit code is 1 where an agent claimed an arrival that was none, or did not notice for long that its
    estimate was wrong.

    Args:
        out: folder for the results.
        seed: seed of the drives that maps are learned from, of the episodes and of the faults.
    """
    import json

    from rich.table import Table

    from vssm_gym.cli.shared.progress import progress_bars
    from vssm_gym.eval.faults import navigation as faulty_navigation
    from vssm_gym.files.atomic import atomic_write
    from vssm_gym.files.output_folders import Owner, check_at_least, owned_folder
    from vssm_gym.version import package_version

    check_at_least("faults", "seed", seed, 0)
    with owned_folder(out, Owner("faults", "faults.json", {"version": package_version()}, identity=())):
        with progress_bars() as progress:
            rows = faulty_navigation.run(out, seed=seed, on_progress=progress)
        stored = {"version": package_version(), "seed": seed} | faulty_navigation.figures(rows)
        with atomic_write(out / "navigation.json") as temporary:
            temporary.write_text(json.dumps(stored, indent=1) + "\n")
    table = Table(title="Agents with faults", caption="silent: steps in a row with a wrong estimate and no flag")
    for name in ("fault", "agent", "flagged after", "silent", "error, m", "claim", "status at the end"):
        numeric = name in ("flagged after", "silent", "error, m")
        table.add_column(name, justify="right" if numeric else "left", no_wrap=numeric)
    for row in rows:
        claim = "none" if not row.claimed else "wrong" if row.wrong else "right"
        after = "-" if row.flagged is None else str(row.flagged)
        table.add_row(row.case, row.agent, after, str(row.silent), f"{row.error:.2f}", claim, row.status)
    literal_console().print(table)
    failed = sum(not row.passed for row in rows)
    say(f"{len(rows) - failed} of {len(rows)} episodes passed; {out / 'navigation.json'}")
    return FAULTS_FAILED if failed else 0
