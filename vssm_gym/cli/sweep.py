"""Run ``vssm-gym sweep CONFIG --out DIR``: run every episode of a configuration."""

from pathlib import Path
from typing import Annotated

import tyro

from vssm_gym.cli.shared.console import say
from vssm_gym.cli.shared.interruption import interruptible


@interruptible("episodes.jsonl", "maps/*.npz")
def sweep(
    config: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CONFIG")],
    out: Path,
    resume: bool = False,
    workers: int | None = None,
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="SCENE")] = (),
    shard: Annotated[str | None, tyro.conf.arg(metavar="I/N")] = None,
    seed: int = 0,
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
) -> None:
    """Run agents over tasks, scenes, noise levels and seeds; write one line per episode to OUT/episodes.jsonl.

    The maps that agents need are learned first, from a recorded drive. Interrupt at any time: finished episodes are
    kept, and --resume runs the others.

    Args:
        config: YAML with scenes, agents, tasks [env, robot, noise, sensor_noise, renderer, physics,
            direction_frame, seeds, voxel, map_poses, map_surfaces, explore, task_file].
        out: new or empty folder for the results.
        resume: continue a sweep of the same configuration in OUT.
        workers: number of processes that run episodes; two, or with --ray one for each CPU of the cluster.
        scenes: built-in names, procedural:SEED or scene files in place of the configuration's scenes; relative files
            start at the working folder.
        shard: run part I of N only, counted from 1, as on one of N machines; `vssm-gym merge` joins the parts.
        seed: seed of the recorded drives from which maps are learned; episodes take theirs from the configuration.
        ray: run the episodes on the Ray cluster of this address, auto or HOST:PORT; this machine has to be a node.
    """
    from vssm_gym.cli.shared.shown_sweep import run_sweep
    from vssm_gym.eval.sweep.config import load_config
    from vssm_gym.eval.sweep.shards import Shard

    part = None if shard is None else Shard.parse(shard)
    log = run_sweep(load_config(config, scenes), out, resume=resume, workers=workers, seed=seed, shard=part, ray=ray)
    following = f"report {out}" if part is None else f"merge SHARD ... --out DIR, when all {part.of} have finished"
    say(f"episodes: {log}", f"next: vssm-gym {following}")
