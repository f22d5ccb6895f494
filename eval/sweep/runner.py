"""Run every episode of a configuration once over worker processes, and resume after interruptions: ``sweep CONFIG``.

The folder holds ``sweep.json`` (configuration, its hash, version), ``tasks/``, ``recordings/``, ``maps/`` and
``episodes.jsonl``. Only this process writes them; a worker that dies loses its own episode only. Workers of
explorers write whole files to ``explored/``: the final maps of the first run of each agent in each scene.
"""

import itertools
import multiprocessing
import sys
import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from vssm_gym.envs.scenes.faults import SceneWarning
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, EpisodeLog, episode_key
from vssm_gym.eval.episodes.manifest import MANIFEST
from vssm_gym.eval.protocols.registry import protocol_of
from vssm_gym.eval.sweep import worker
from vssm_gym.eval.sweep.config import SweepConfig, expand
from vssm_gym.eval.sweep.given_map import copy_map
from vssm_gym.eval.sweep.jobs import jobs_of
from vssm_gym.eval.sweep.manifest import manifest_of
from vssm_gym.eval.sweep.own_agents import check_importable, own_agents
from vssm_gym.eval.sweep.pools import WORKERS, PoolOf, pools
from vssm_gym.eval.sweep.rounds import Rounds
from vssm_gym.eval.sweep.shards import Part
from vssm_gym.files.output_folders import RESUME, Owner, check_at_least, check_folder, owned_folder
from vssm_gym.files.shipped import MAPS, shipped
from vssm_gym.progress import OnProgress

SHARED = 8  # scenes whose episodes share workers: what agents compile for the shapes of a scene stays in memory


def run_sweep(
    config: SweepConfig,
    out: str | Path,
    *,
    resume: bool = False,
    workers: int | None = None,
    seed: int = 0,
    shard: Part | None = None,
    map_file: Path | None = None,
    agent_seconds: float | None = None,
    ray: str | None = None,
    on_progress: OnProgress | None = None,
) -> Path:
    """Run the episodes of a configuration that are not yet in ``out/episodes.jsonl``.

    Each row is on disk as soon as its episode ends. Ctrl-C lets the episodes that are running end (seconds), keeps them
    and raises KeyboardInterrupt.

    Args:
        config: checked by :func:`vssm_gym.eval.sweep.config.load_config`; its agents may be the program's own.
        out: new or empty folder, or with ``resume`` that of a sweep of the same configuration and seed.
        resume: continue; with no episode there yet, begin.
        workers: processes; None: two, or one for each CPU of a cluster.
        seed: of the recorded drives that maps are learned from; episodes take theirs from the configuration.
        shard: the part of the episodes to run; None: all of them.
        map_file: a map for the agents of a configuration of one scene, which is copied; None: maps are learned.
        agent_seconds: of processor time that an agent may use in an episode. With it, an agent's errors, wrong
            decisions and lost time are failures of its episodes; None: its time is its own, its errors end the sweep.
        ray: address of a Ray cluster whose machines run the episodes; None: this machine does.
        on_progress: called with ("recording" | "map" | "episodes" | "ending", done, total).

    Returns:
        The file ``out/episodes.jsonl``.

    Raises:
        InputError: the folder is not this sweep's, or one is running in it; a scene that cannot be used; a worker died
            (:class:`WorkerDiedError`); no such cluster, or one of other versions; a program that workers cannot import;
            an agent that returns no decision.
        OutputError: a full disk or the like; the episodes before are kept.
        RuntimeError: an error inside an agent, whose traceback precedes it; the message names scene and task.
    """
    leave_unguarded_import()
    out = Path(out)
    own = own_agents(config.agents)
    check_importable(own)
    check_at_least("sweep", "workers", WORKERS if workers is None else workers, 1)
    check_at_least("sweep", "seed", seed, 0)
    check_folder(out)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # the manifest has them as notices
        apartments = {scene: protocol_of(config.env[0]).load(scene) for scene in config.scenes}
        hashes = {scene: apartment.content_hash() for scene, apartment in apartments.items()}
        episodes = list(expand(config))
        if shard is not None:
            episodes = shard.part(episodes)
        if map_file is not None:
            map_file = shipped(map_file, MAPS)
        manifest = manifest_of(config, apartments, seed, len(episodes), shard, map_file)
        identity = ("map_hash", "agent_code", "config_hash", "shard")
        owner = Owner("sweep", MANIFEST, manifest, identity=identity, resumed=(FILE,))
        with (
            pools(workers, ray, tuple(own.values())) as pool_of,
            owned_folder(out, owner, resume),
            EpisodeLog(out / FILE) as log,
        ):
            done = {episode_key(row) for row in log.rows}
            todo = [e for e in episodes if episode_key(e.identity(hashes[e.condition.scene])) not in done]

            def jobs_of_scenes() -> Iterator[list[worker.Job]]:
                for scene in dict.fromkeys(episode.condition.scene for episode in todo):
                    batch = [episode for episode in todo if episode.condition.scene == scene]
                    if map_file is not None:
                        copy_map(map_file, out / "maps" / f"{scene_name(scene)}.npz")
                    jobs = jobs_of(batch, scene, apartments[scene], out, config, manifest, on_progress)
                    yield [replace(job, agent_seconds=agent_seconds) for job in jobs]

            for jobs in _batches(jobs_of_scenes()):
                worker.release_memory()
                _run(jobs, log, pool_of, len(episodes), on_progress)
    return out / FILE


def leave_unguarded_import() -> None:
    """End a worker process that imports a program without a guard, and would start a sweep; its parent reports it."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(1)


def _batches(scenes: Iterable[list[worker.Job]]) -> Iterator[list[worker.Job]]:
    """Yield the jobs that workers are started for: those of each scene with a map, and of SHARED others together.

    Scenes keep their order. What workers compile is freed with them: what agents with a map compile has the map's shape
    and is of no use elsewhere, of the others' functions most serve all scenes.
    """
    together: list[list[worker.Job]] = []
    for jobs in scenes:
        mapped = any(job.map_file for job in jobs)
        if together and (mapped or len(together) == SHARED):
            yield list(itertools.chain.from_iterable(together))
            together = []
        if mapped:
            yield jobs
        else:
            together.append(jobs)
    if together:
        yield list(itertools.chain.from_iterable(together))


def _run(jobs: list[worker.Job], log: EpisodeLog, pool_of: PoolOf, total: int, on_progress: OnProgress | None) -> None:
    """Run all jobs over workers of their own, whose memory is freed at the end; log results as they come.

    One episode of each agent that uses the map runs first on each machine, one after the other: it fills the
    compilation cache for the others. Two workers that compile at once would take twice the time and memory.
    """

    def report() -> None:
        if on_progress:
            on_progress("episodes", len(log.rows), total)

    def keep(row: dict[str, Any]) -> None:
        log.append(row)
        report()

    report()
    kept = lambda: f"{len(log.rows)} of {total} episodes are kept ({RESUME})"
    rounds = Rounds(pool_of, len(jobs), keep, kept)
    try:
        first = _first(jobs, rounds.pool.machines)
        for batch in first:
            rounds.run([(job, machine) for machine, job in enumerate(batch)])
        begun = set(itertools.chain(*first))
        rounds.run([(job, None) for job in jobs if job not in begun])
    except KeyboardInterrupt:
        rounds.interrupted(lambda done, running: on_progress("ending", done, running) if on_progress else None)
        if len(log.rows) < total:
            raise
    except InputError as error:
        raise error.with_traceback(None) from None
    except Exception as error:
        error.add_note(kept())
        raise error.with_traceback(None) from error.__cause__
    finally:
        rounds.close()


def _first(jobs: Sequence[worker.Job], machines: int) -> list[list[worker.Job]]:
    """Return the first jobs of each agent that uses the map, one for each machine if there are so many."""
    agents: dict[str, list[worker.Job]] = {}
    for job in jobs:
        if job.map_file and len(found := agents.setdefault(job.episode.agent, [])) < machines:
            found.append(job)
    return list(agents.values())
