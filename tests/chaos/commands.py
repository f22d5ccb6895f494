"""Define the commands that are disturbed: small runs, and what has to stay of them."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Kept = dict[str, Any]  # what a run has finished, by name


@dataclass(frozen=True)
class Command:
    """Describe a command of ``vssm-gym`` that is disturbed.

    Attributes:
        arguments: all but ``--out DIR``; ``{0}`` is the folder with the inputs.
        kept: returns what is finished in its folder, by name, each of which has to stay there.
        result: returns what runs that ended agree in.
        share: of the kills.
        final: the file that only a finished output has, which is then refused; None: ``--resume`` continues any.
        before: Python code that makes it smaller.
        needs: modules without which it is left out.
    """

    arguments: str
    kept: Callable[[Path], Kept]
    result: Callable[[Path], object]
    share: float
    final: str | None = None
    before: str = ""
    needs: tuple[str, ...] = ()


def rows_of(out: Path) -> dict[str, Any]:
    """Return the episodes of a sweep by their identity, without what a clock measured."""
    path = out / "episodes.jsonl"
    lines = path.read_bytes().splitlines(keepends=True) if path.is_file() else []
    rows = [json.loads(line) for line in lines if line.endswith(b"\n")]
    names = ("env", "scene", "agent", "noise", "task", "seed")
    return {" ".join(str(row.get(name)) for name in names): without_times(row) for row in rows}


def without_times(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row without what a clock measured, and the version: a commit made meanwhile changes it."""
    return {name: value for name, value in row.items() if name not in ("latency", "version")}


def digests(out: Path, names: Sequence[str]) -> Kept:
    """Return a hash of each file that is there."""
    found = {name: out / name for name in names if (out / name).is_file()}
    return {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in found.items()}


def sweep_kept(out: Path) -> Kept:
    """Return rows and maps."""
    maps = [str(path.relative_to(out)) for path in (out / "maps").glob("*.npz")]
    return rows_of(out) | digests(out, maps)


def record_kept(out: Path) -> Kept:
    """Return all files of a recording, which is there whole or not at all."""
    files = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.is_file())
    return digests(out, files) | ({"frames": len(files)} if files else {})


def slam_kept(out: Path) -> Kept:
    """Return the trajectory; the other files hold times, so they are named only."""
    names = ("map.npz", "mesh.ply", "stats.json", "report.html")
    return digests(out, ["trajectory.txt"]) | {name: True for name in names if (out / name).is_file()}


def train_kept(out: Path) -> Kept:
    """Return the lines of the log up to the last checkpoint, and the policy's presence."""
    import torch

    if not (out / "checkpoint.pt").is_file():
        return {}
    steps = torch.load(out / "checkpoint.pt", weights_only=True)["counters"]["num_timesteps"]
    lines = (out / "progress.jsonl").read_bytes().splitlines(keepends=True)
    rows = [json.loads(line) for line in lines if line.endswith(b"\n")]
    return {f"line {i}": row for i, row in enumerate(rows) if row["steps"] <= steps} | {"policy": True}


def train_result(out: Path) -> object:
    """Return whether all steps were made, the log goes forward and a policy is there.

    The rest differs: episodes begin anew, and updates after an interrupted one end at other steps.
    """
    rows = [json.loads(line) for line in (out / "progress.jsonl").read_text().splitlines()]
    steps = [row["steps"] for row in rows]
    return steps[-1] >= TRAIN_STEPS, steps == sorted(steps), (out / "policy.npz").is_file()


def shown_kept(out: Path) -> Kept:
    """Return the names of what an exploration or a navigation shows, and the map that was built."""
    names = ("run.json", "candidates.png", "run.png", "mesh.png", "run.mp4")
    return digests(out, ["map.npz"]) | {name: True for name in names if (out / name).is_file()}


def shown_result(out: Path) -> object:
    """Return the row and the map."""
    return without_times(json.loads((out / "run.json").read_text())), shown_kept(out)


TRAIN_STEPS = 40_000
FEWER = (
    "import vssm_gym.eval.sweep.config as c\nload = c.load_config\n"
    "c.load_config = lambda path: load(path).model_copy(update={'tasks': (0, 1)})\n"
)
OFTEN = "import vssm_gym.training.run as r\nr.CHECKPOINT_SECONDS, r.ROW_SECONDS = 1.0, 0.3\n"
COMMANDS = {
    "sweep": Command("sweep {0}/sweep.yaml --resume", sweep_kept, rows_of, 0.3),
    "demo": Command("demo --resume", sweep_kept, rows_of, 0.12, before=FEWER),
    "record": Command("record --scene {0}/home.json --size 80x60", record_kept, record_kept, 0.16, "camera.json"),
    "slam": Command("slam {0}/walk --size 80x60 --voxel 0.1 --extent 10", slam_kept, slam_kept, 0.16, "report.html"),
    "train": Command(
        "train {0}/train.yaml --map {0}/home.npz --resume",
        train_kept,
        train_result,
        0.12,
        before=OFTEN,
        needs=("torch",),
    ),
    "explore": Command(
        "explore --scene {0}/home.json --steps 60",
        shown_kept,
        shown_result,
        0.14,
        "run.mp4",
        needs=("imageio_ffmpeg",),
    ),
    "navigate": Command(
        "navigate --scene {0}/home.json --start 1,2 --goal 5,2 --agent random --steps 60",
        shown_kept,
        shown_result,
        0.1,
        "run.mp4",
        needs=("imageio_ffmpeg",),
    ),
}
INPUTS = {
    "walk": "record --scene {0}/home.json --motion handheld --metres 4 --size 80x60 --out {0}/walk",
    "drive": "record --scene {0}/home.json --size 80x60 --out {0}/drive",
    "home.npz": "map build {0}/drive --voxel 0.1 --out {0}/home.npz",
}
CONFIGS = {
    "sweep.yaml": "scenes: home.json\nagents: [random, oracle]\ntasks: 4\nvoxel: 0.1\n",
    "train.yaml": (
        "name: tiny\nenvironment: {id: vssm_gym/WorldModelNav-v0, num_envs: 16, max_episode_steps: 100, goals: 16,\n"
        "  pool: 256}\npolicy: {inputs: [scan, goal], hidden: [16]}\n"
        "algorithm: {name: ppo, n_steps: 16, batch_size: 128, n_epochs: 2}\n"
        f"steps: {TRAIN_STEPS}\n"
    ),
}
