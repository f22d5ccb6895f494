"""Remove example additions one by one, each of which should be one file and one row, and run the tests.

    python tests/remove_additions.py [NAME ...] [-- PYTEST ARGUMENTS]

Each addition is removed from a copy of the checkout: its files whole, and its rows from the registries. What remains
must pass; by default the fast tests, several minutes an addition.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Addition:
    """List the files and rows of an addition.

    Attributes:
        files: that exist for it alone.
        rows: file to a pattern; its lines that match are the addition's.
    """

    files: tuple[str, ...]
    rows: dict[str, str] = field(default_factory=dict)


# The pages still describe what was taken out, so the tests of the pages are left out.
FAST = ["-m", "not slow", "-n", "2", "--ignore=tests/test_docs.py"]
SENSORS, METRICS = "vssm_gym/envs/sensors/registry.py", "eval/metrics/registry.py"
DRIVE = r"Differential|DIFFERENTIAL"
ADDITIONS = {
    "gps_compass": Addition(
        ("vssm_gym/envs/sensors/gps_compass.py", "tests/envs/sensors/test_gps_compass.py"),
        {SENSORS: r"gps_compass|GpsCompass"},
    ),
    "bumper": Addition(
        ("vssm_gym/envs/sensors/bumper.py", "tests/envs/sensors/test_bumper.py"), {SENSORS: r"bumper|Bumper"}
    ),
    "collision_rate": Addition(
        ("eval/metrics/collision_rate.py", "tests/eval/test_collision_rate.py"),
        {METRICS: r"collision_rate|COLLISION_RATE"},
    ),
    "theta_star": Addition(
        ("vssm_gym/planning/grid_search/theta_star.py", "tests/planning/test_theta_star.py"),
        {"vssm_gym/planning/planners.py": r"theta_star"},
    ),
    "differential_drive": Addition(
        (
            "vssm_gym/model/transition/differential.py",
            "vssm_gym/envs/robots/differential.py",
            "tests/model/test_differential.py",
        ),
        {
            "docs/library.md": DRIVE,
            "vssm_gym/__init__.py": DRIVE,
            "vssm_gym/model/transition/__init__.py": DRIVE,
            "vssm_gym/envs/robots/registry.py": DRIVE,
            "eval/protocols/agent_context.py": DRIVE,
        },
    ),
}


def copy_checkout(target: Path) -> None:
    """Copy every tracked file, links as links, and make ``shared`` data beside the checkout reachable."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=CHECKOUT, check=True, capture_output=True).stdout
    for name in filter(None, listed.decode().split("\0")):
        source = CHECKOUT / name
        if source.exists() or source.is_symlink():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(source, target / name, follow_symlinks=False)
    if (CHECKOUT.parent / "shared").is_dir():
        (target.parent / "shared").symlink_to(CHECKOUT.parent / "shared")


def remove(addition: Addition, checkout: Path) -> None:
    """Delete the addition's files and rows; one that is not there is an error: this list would be out of date."""
    for name in addition.files:
        (checkout / name).unlink()
    for name, pattern in addition.rows.items():
        path = checkout / name
        lines = path.read_text().splitlines(keepends=True)
        kept = [line for line in lines if not re.search(pattern, line)]
        if len(kept) == len(lines):
            raise SystemExit(f"{name}: no line matches {pattern}")
        path.write_text("".join(kept))


def main(arguments: list[str]) -> int:
    """Remove each of the named additions, all of them by default; return how many broke something."""
    cut = arguments.index("--") if "--" in arguments else len(arguments)
    names, pytest = arguments[:cut] or list(ADDITIONS), arguments[cut + 1 :] or FAST
    if unknown := set(names) - set(ADDITIONS):
        raise SystemExit(f"additions: {', '.join(ADDITIONS)}; not {', '.join(sorted(unknown))}")
    broken = 0
    for name in names:
        with tempfile.TemporaryDirectory() as scratch:
            checkout = Path(scratch) / "checkout"
            copy_checkout(checkout)
            remove(ADDITIONS[name], checkout)
            sys.stdout.write(f"without {name}\n")
            sys.stdout.flush()
            own = {**os.environ, "PYTHONPATH": str(checkout)}  # processes that tests start import this copy too
            broken += bool(subprocess.run([sys.executable, "-m", "pytest", *pytest], cwd=checkout, env=own).returncode)
    return broken


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
