"""Run the episodes of a sweep on a Ray cluster, whose machines need not share a folder.

Scene, map, tasks and policy of an episode travel as files, by their content; a scene as its canonical JSON, whatever
its own format is. The row comes back, and so does the map of an explorer: only the process of the sweep writes.
"""

import tempfile
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vssm_gym.agents.policy.policy_file import PREFIX as POLICY
from vssm_gym.cluster.ray_cluster import Calls, Cluster, SharedFile
from vssm_gym.envs.scenes.generator import PREFIX as GENERATED
from vssm_gym.envs.scenes.scene import save_scene
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols.registry import protocol_of
from vssm_gym.eval.sweep import worker
from vssm_gym.files.atomic import atomic_write

if TYPE_CHECKING:
    from vssm_gym.agents.base import Agent


@dataclass(frozen=True)
class Luggage:
    """Hold the files of a job that travel; None for what it does not need, or what every machine has."""

    task_file: SharedFile
    map_file: SharedFile | None
    scene: SharedFile | None
    policy: SharedFile | None


class RayPool:
    """Run jobs on a cluster; a process or machine that dies costs its present episode a repetition.

    Args:
        cluster: that this process is connected to.
        processes: jobs at once.
        waiting: more jobs that Ray holds.
        own: classes of the agents that the program has registered.
    """

    def __init__(self, cluster: Cluster, processes: int, waiting: int = 0, own: "tuple[type[Agent], ...]" = ()) -> None:
        self._nodes, self._own = cluster.machines, own
        self.machines, self.processes = len(self._nodes), processes
        self._calls = Calls(cluster, processes, waiting)
        self._share = cache(self._calls.share)  # a file is read once
        self._scene = cache(self._scene_file)

    def submit(self, job: worker.Job, machine: int | None = None) -> "Future[dict[str, Any]]":
        """Return the future row of a job; an explorer's map is written before it."""
        episode = job.episode
        luggage = Luggage(
            self._share(job.task_file),
            self._share(job.map_file) if job.map_file else None,
            self._scene(episode.condition.env, episode.condition.scene),
            self._share(Path(episode.agent.removeprefix(POLICY))) if episode.agent.startswith(POLICY) else None,
        )
        node = None if machine is None else self._nodes[machine]
        return self._calls.submit(run_there, job, luggage, self._own, node=node, then=partial(_received, job))

    def stop(self) -> None:
        """Begin no further job but those that Ray holds."""
        self._calls.stop()

    def close(self) -> None:
        """End the processes of these jobs and remove the files that travelled."""
        self._calls.close()

    def lost(self, kept: str) -> InputError:
        """Return the error for an episode that was lost too often."""
        expected = "a cluster whose processes live; an episode lost its process again and again, possibly for lack of"
        return worker.WorkerDiedError("sweep", "--ray", f"{expected} memory; {kept}")

    def _scene_file(self, env: str, scene: str) -> SharedFile | None:
        """Return the canonical JSON of a scene from a file; None where every machine has it."""
        protocol = protocol_of(env)
        if scene in protocol.scene_names() or scene.startswith(GENERATED):
            return None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"{scene_name(scene)}.json")
            save_scene(protocol.load(scene), path)
            return self._calls.share(path)


def run_there(job: worker.Job, luggage: Luggage, own: "tuple[type[Agent], ...]") -> tuple[dict[str, Any], bytes | None]:
    """Run a job on a machine of the cluster; return its row, and the map of an explorer.

    Raises:
        InputError: as :func:`vssm_gym.eval.sweep.worker.run`; a scene whose content is another one on this machine.
    """
    worker.prepare(own)
    task_file, episode = luggage.task_file.path(), job.episode
    if luggage.scene is not None:
        episode = replace(episode, condition=replace(episode.condition, scene=str(luggage.scene.path())))
    if luggage.policy is not None:
        episode = replace(episode, agent=f"{POLICY}{luggage.policy.path()}")
    _check_scene(episode.condition.env, episode.condition.scene, job.scene_hash)
    with tempfile.TemporaryDirectory(dir=task_file.parent) as folder:
        explored = Path(folder, job.explored_file.name) if job.explored_file else None
        map_file = luggage.map_file.path() if luggage.map_file else None
        row = worker.run(replace(job, episode=episode, task_file=task_file, map_file=map_file, explored_file=explored))
        return row, explored.read_bytes() if explored is not None and explored.is_file() else None


@cache
def _check_scene(env: str, scene: str, expected: str) -> None:
    """Raise :class:`InputError` unless a scene has the content that the sweep has found in it."""
    found = protocol_of(env).load(scene).content_hash()
    if found != expected:
        raise InputError("--ray", f"scene {scene_name(scene)}", f"content {expected} on every machine; found {found}")


def _received(job: worker.Job, found: tuple[dict[str, Any], bytes | None]) -> dict[str, Any]:
    """Return the row of a job, after its explored map, if there is one, has been written."""
    row, explored = found
    if explored is not None and job.explored_file is not None:
        job.explored_file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(job.explored_file) as temporary:
            temporary.write_bytes(explored)
    return row
