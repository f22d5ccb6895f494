"""Run one exploration and keep its row, final map, pictures and video."""

import json
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

from vssm_gym.agents.registry import make_agent
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.eval.episodes.identity import scene_name
from vssm_gym.eval.protocols import explore as explore_protocol
from vssm_gym.eval.protocols.episode import StepRecord
from vssm_gym.eval.protocols.explore_episode import map_of
from vssm_gym.eval.sweep.config import SweepConfig, expand
from vssm_gym.eval.sweep.runner import config_hash
from vssm_gym.eval.video import pictures
from vssm_gym.eval.video.explorer import write_video
from vssm_gym.eval.video.recording import Recording
from vssm_gym.files.atomic import atomic_write
from vssm_gym.progress import OnProgress
from vssm_gym.version import package_version
from vssm_gym.viz.mesh import surface_mesh
from vssm_gym.viz.mesh_picture import mesh_picture

PICTURE_DPI = 110  # of the pictures


def explore(config: SweepConfig, out: Path, on_progress: OnProgress | None = None) -> dict[str, Any]:
    """Run the one episode of ``config`` and write the folder ``out``, which appears whole or not at all.

    Args:
        config: of Explore, with one scene, one agent, one value of each condition, one task and one seed.
        out: new or empty folder; see ``vssm-gym explore --help`` for what is in it.
        on_progress: called with ("exploring" | "video", done, total).

    Returns:
        The row of a sweep of ``config``.
    """
    (episode,) = expand(config)
    apartment, agent = load_scene(episode.condition.scene), make_agent(episode.agent)
    recording = Recording(agent)
    limit = episode.explore.steps if episode.explore else 0

    def see(step: StepRecord) -> None:
        recording(step)
        if on_progress:
            on_progress("exploring", step.number, limit)

    with tempfile.TemporaryDirectory() as folder:
        task_file = Path(folder) / "tasks.json"
        explore_protocol.write_tasks(apartment, episode.task + 1, task_file)
        result = explore_protocol.run(episode, agent, task_file, None, see)
    if on_progress:
        on_progress("exploring", limit, limit)
    content, version = apartment.content_hash(), package_version()
    hashed = config_hash(config, {episode.condition.scene: content}, 0)
    signature = {"version": version, "config_hash": hashed, "map_hash": None}
    row = episode.identity(content) | signature | result
    explored = map_of(agent)
    assert explored is not None  # every explorer of the registry keeps one
    with atomic_write(out) as unfinished:
        unfinished.mkdir()
        text = json.dumps(row, allow_nan=False, indent=1) + "\n"
        (unfinished / "run.json").write_text(text, encoding="utf-8")
        explored.save(unfinished / "map.npz", agent=row["agent"], scene_hash=content, package_version=version)
        choice = recording.choice()
        if choice is not None:
            pictures.candidates(choice, recording).savefig(unfinished / "candidates.png", dpi=PICTURE_DPI)
        pictures.run(recording, explored, row).savefig(unfinished / "run.png", dpi=PICTURE_DPI)
        Image.fromarray(mesh_picture(surface_mesh(explored))).save(unfinished / "mesh.png")
        title = f"{row['agent']} explores {scene_name(episode.condition.scene)}"
        write_video(unfinished / "run.mp4", recording, title, on_progress)
    return row
