"""Make a sweep that has finished, and copies of its folder whose last row is another."""

import json
from pathlib import Path
from typing import Any

from vssm_gym.eval.episodes.log import FILE
from vssm_gym.eval.sweep.config import SweepConfig

DIST_BUG = SweepConfig(
    env=("vssm_gym/LidarMaze-v0",),
    scenes=("pillars-v1",),
    agents=("dist_bug",),
    robot=("disc",),
    physics=("none",),
    noise=("none", "low"),
    tasks=(0, 7, 9),
)


def altered(folder: Path, tmp_path: Path, **change: Any) -> Path:
    """Return a copy of a sweep's folder whose last row has other values."""
    copy = tmp_path / "altered"
    copy.mkdir()
    (copy / "sweep.json").write_text((folder / "sweep.json").read_text())
    rows = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    rows[-1] |= change
    (copy / FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    return copy
