"""Evaluate a trained policy in the simulator, through the ordinary sweep, and in imagination: ``evaluate POLICY``."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vssm_gym.agents.policy import policy_file
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.envs.tasks.navigation import load
from vssm_gym.envs.world_model.config import Imagination
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import read_rows
from vssm_gym.eval.episodes.row import identified
from vssm_gym.eval.metrics import aggregate
from vssm_gym.eval.metrics.aggregate import Interval
from vssm_gym.eval.sweep.config import DEFAULT_VOXEL, SweepConfig, check_names
from vssm_gym.eval.sweep.runner import run_sweep
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.shipped import POLICIES, shipped
from vssm_gym.maps.map_file import map_hash
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.transition.learned_file import transition_hash
from vssm_gym.progress import OnProgress
from vssm_gym.training.imagined_episodes import imagine, real_return

FILE = "evaluation.json"
ARGUMENTS = {"scenes": "scene", "agents": "policy"}  # of the command, by fields of a sweep
METRICS = ("spl", "success", "collisions", "return")


@dataclass(frozen=True)
class Evaluation:
    """Hold means over tasks with 95 % intervals, by metric.

    Attributes:
        label: the policy's name and hash.
        real: in the simulator.
        imagined: in the learned map; None where a task does not fit that map.
        gap: imagined - real, paired by task; None likewise.
        notice: why there is no imagined part, else empty.
    """

    label: str
    real: Mapping[str, Interval]
    imagined: Mapping[str, Interval] | None
    gap: Mapping[str, Interval] | None
    notice: str


def evaluate_policy(
    policy: Path,
    out: Path,
    *,
    scene: str,
    tasks: int,
    robot: str = "holonomic",
    noise: str = "low",
    transition: Path | None = None,
    map_file: Path | None = None,
    resume: bool = False,
    workers: int = 2,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> Evaluation:
    """Run the sweep and the imagined episodes; write ``evaluation.json`` into the sweep's folder.

    Args:
        policy: file of `vssm-gym train`, or the name of a policy that comes with the package.
        out: new or empty folder, or that of the same evaluation with ``resume``.
        scene: built-in name or path of a scene file.
        tasks: the first so many test tasks.
        robot: that drives in the simulator: holonomic or worn.
        noise: of execution.
        transition: by which robots move in imagination; None: by the holonomic robot's law.
        map_file: for the agents and for imagination, such as the one trained in; None: it is learned from a drive.
        resume: continue.
        workers: processes.
        seed: of the drive that a map is learned from, and of imagination.
        on_progress: called as by :func:`vssm_gym.eval.sweep.runner.run_sweep`.

    Raises:
        InputError: as :func:`run_sweep`, for a file that is not a policy or a map, or where the folder holds an
            evaluation in another map.
    """
    policy = shipped(policy, POLICIES)
    agent = f"{policy_file.PREFIX}{policy.resolve()}"
    voxel = DEFAULT_VOXEL if map_file is None else round(float(VoxelMap.load(map_file).voxel_size), 6)
    config = SweepConfig(
        scenes=(scene,), agents=(agent,), robot=(robot,), noise=(noise,), tasks=tuple(range(tasks)), voxel=voxel
    )
    check_names(config, "evaluate", ARGUMENTS)
    Imagination(transition=transition).learned()  # a file that does not fit is refused before anything runs
    log = run_sweep(config, out, resume=resume, workers=workers, seed=seed, map_file=map_file, on_progress=on_progress)
    rows = [{**row, "return": real_return(row), "world": "real"} for row in read_rows(log)]
    task_file, agents_map = files_of(out, scene)
    set_ = load(task_file).tasks[:tasks]
    try:
        found = imagine(policy_file.load(str(policy)), agents_map, set_, noise, seed, transition=transition)
    except InputError as error:
        evaluation = Evaluation(policy_file.agent_label(agent), _means(rows), None, None, str(error))
    else:
        same = {key: identified(rows[0], key) for key in (*aggregate.CONDITION, "agent", "seed")}
        imagined = [{**same, **row, "world": "imagined"} for row in found]
        pairs = [*rows, *imagined]
        gap = {metric: aggregate.paired_difference(pairs, metric, "imagined", "real", by="world") for metric in METRICS}
        evaluation = Evaluation(rows[0]["agent"], _means(rows), _means(imagined), gap, "")
    with atomic_write(out / FILE) as temporary:
        stored = _plain(evaluation) | {"map": map_hash(agents_map)}
        stored |= {"transition": None if transition is None else transition_hash(transition)}
        temporary.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
    return evaluation


def files_of(out: Path, scene: str) -> tuple[Path, Path]:
    """Return the files of an evaluation's tasks and of the map of its agents."""
    name = scene_name(scene)
    return out / "tasks" / f"{name}-holonomic.json", out / "maps" / f"{name}.npz"


def _means(rows: list[dict[str, Any]]) -> dict[str, Interval]:
    return {metric: aggregate.mean(rows, metric) for metric in METRICS}


def _plain(evaluation: Evaluation) -> dict[str, Any]:
    """Convert to JSON values: [mean, low, high], null where one task gives no interval."""
    known = lambda value: value if math.isfinite(value) else None
    numbers = lambda means: means and {k: [known(v) for v in (i.mean, i.low, i.high)] for k, i in means.items()}
    return {
        "policy": evaluation.label,
        "real": numbers(evaluation.real),
        "imagined": numbers(evaluation.imagined),
        "gap": numbers(evaluation.gap),
        "notice": evaluation.notice,
    }
