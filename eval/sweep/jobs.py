"""Make the jobs of a scene's episodes: their tasks, the map that agents are given or that is learned, their files."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.eval.episodes.identity import Episode
from vssm_gym.eval.episodes.row import without_defaults
from vssm_gym.eval.protocols.given_tasks import write_given_tasks
from vssm_gym.eval.protocols.registry import SWEPT_ENVIRONMENTS, protocol_of
from vssm_gym.eval.sweep import worker
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.maps.map_file import map_hash
from vssm_gym.progress import OnProgress
from vssm_gym.version import package_version


def jobs_of(
    episodes: Sequence[Episode],
    scene: str,
    apartment: Apartment,
    out: Path,
    config: SweepConfig,
    manifest: dict[str, Any],
    on_progress: OnProgress | None,
) -> list[worker.Job]:
    """Draw the tasks of a scene and learn its map if an agent needs it; return the jobs of its episodes."""
    from vssm_gym.agents.registry import agent_type

    map_file = None
    task_files = {}
    for env in dict.fromkeys(episode.condition.env for episode in episodes):
        task_files[env] = out / "tasks" / f"{scene_name(scene)}-{SWEPT_ENVIRONMENTS[env].robot}.json"
        if config.task_file is None:
            protocol_of(env).write_tasks(apartment, max(config.tasks) + 1, task_files[env])
        else:
            write_given_tasks(Path(config.task_file), apartment, max(config.tasks) + 1, task_files[env])
    if any(agent_type(episode.agent).needs_map for episode in episodes):
        if "map_hash" in manifest:
            map_file = out / "maps" / f"{scene_name(scene)}.npz"
        else:
            map_file = protocol_of(config.env[0]).ensure_map(
                scene,
                out,
                voxel=config.voxel,
                seed=manifest["seed"],
                poses=config.map_poses,
                surfaces=config.map_surfaces,
                on_progress=on_progress,
            )
    with_map, without = (map_file, map_hash(map_file) if map_file else None), (None, None)
    maps = {agent: with_map if agent_type(agent).needs_map else without for agent in config.agents}
    signature = apartment.content_hash(), manifest["config_hash"], package_version()
    return [
        worker.Job(
            episode,
            *maps[episode.agent],
            task_files[episode.condition.env],
            *signature,
            explored_file=_explored_file(episode, out, config),
        )
        for episode in episodes
    ]


def _explored_file(episode: Episode, out: Path, config: SweepConfig) -> Path | None:
    """Return the file for the map of an explorer's first run in each world; None for other episodes."""
    c = episode.condition
    first = (episode.task, episode.seed) == (config.tasks[0], config.seeds[0])
    if SWEPT_ENVIRONMENTS[c.env].task != "explore" or not first:
        return None
    frame = without_defaults({"direction_frame": c.direction_frame}).values()
    world = (scene_name(c.scene), c.noise, c.sensor_noise, c.renderer, *frame, episode.agent)
    return out / "explored" / f"{'-'.join(world)}.npz"
