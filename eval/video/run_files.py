"""Write the files that every run of a single episode leaves: its row, its map and its pictures."""

import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from vssm_gym.files.atomic import atomic_write
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz.pictures import png

PICTURE_DPI = 110  # of the pictures
ROW, MAP, PICTURE, VIDEO = "run.json", "map.npz", "run.png", "run.mp4"


def write_row(out: Path, row: dict[str, Any]) -> None:
    """Write the row of a sweep as ``run.json``."""
    with atomic_write(out / ROW) as temporary:
        temporary.write_text(json.dumps(row, allow_nan=False, indent=1) + "\n", encoding="utf-8")


def write_map(out: Path, own: VoxelMap, row: dict[str, Any]) -> None:
    """Write the map that the agent of ``row`` has built as ``map.npz``."""
    own.save(out / MAP, agent=row["agent"], scene_hash=row["scene_hash"], package_version=row["version"])


def write_picture(path: Path, figure: Figure) -> None:
    """Write a figure as PNG."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(png(figure, PICTURE_DPI))
