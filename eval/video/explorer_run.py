"""Run one exploration and keep its row, final map, pictures and video."""

import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

from vssm_gym.agents.registry import make_agent
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.eval.episodes.identity import Episode
from vssm_gym.eval.protocols import explore as explore_protocol
from vssm_gym.eval.protocols.episode import StepRecord
from vssm_gym.eval.protocols.explore_episode import map_of
from vssm_gym.eval.sweep.config import SweepConfig, expand
from vssm_gym.eval.sweep.manifest import config_hash
from vssm_gym.eval.video import explorer_pictures as pictures
from vssm_gym.eval.video.explorer import write_video
from vssm_gym.eval.video.explorer_recording import Recording
from vssm_gym.eval.video.run_files import PICTURE, VIDEO, write_map, write_picture, write_row
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.output_folders import Owner, owned_folder
from vssm_gym.instruction_set import cpu_model
from vssm_gym.progress import OnProgress
from vssm_gym.version import package_version
from vssm_gym.viz.mesh import surface_mesh
from vssm_gym.viz.mesh_picture import mesh_picture

MANIFEST, MESH = "explore.json", "mesh.png"


def explore(
    config: SweepConfig, out: Path, video: bool = True, on_progress: OnProgress | None = None
) -> dict[str, Any]:
    """Run the one episode of ``config`` and write the folder ``out``: map and pictures first, the video last.

    A run that is interrupted in its video leaves what it has written; the same run may use the folder again.

    Args:
        config: of Explore, with one scene, one agent, one value of each condition, one task and one seed.
        out: new or empty folder, or that of an unfinished run of ``config``; see ``vssm-gym explore --help``.
        video: False where no video can be written.
        on_progress: called with ("exploring" | "video", done, total).

    Returns:
        The row of a sweep of ``config``.

    Raises:
        InputError: the folder of another run, or of one that has ended.
        OutputError: a full disk or the like.
    """
    (episode,) = expand(config)
    apartment, version = load_scene(episode.condition.scene), package_version()
    hashed = config_hash(config, {episode.condition.scene: apartment.content_hash()}, 0)
    content = {"config": config.model_dump(mode="json"), "config_hash": hashed, "version": version}
    with owned_folder(out, Owner("exploration", MANIFEST, content, finished=VIDEO if video else MESH)):
        return _explore(episode, apartment, out, hashed, video, on_progress)


def _explore(
    episode: Episode, apartment: Apartment, out: Path, hashed: str, video: bool, on_progress: OnProgress | None
) -> dict[str, Any]:
    """Do the work of :func:`explore` in a folder that it owns."""
    agent = make_agent(episode.agent)
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
        on_progress("exploring", result["steps"], result["steps"])
    content, version = apartment.content_hash(), package_version()
    signature = {"version": version, "processor": cpu_model(), "config_hash": hashed, "map_hash": None}
    row = episode.identity(content) | signature | result
    explored = map_of(agent)
    assert explored is not None  # every explorer of the registry keeps one
    write_map(out, explored, row)
    write_row(out, row)
    choice = recording.choice()
    if choice is not None:
        write_picture(out / "candidates.png", pictures.candidates(choice, recording))
    write_picture(out / PICTURE, pictures.run(recording, explored, row))
    with atomic_write(out / MESH) as temporary:
        Image.fromarray(mesh_picture(surface_mesh(explored))).save(temporary, format="PNG")
    if video:
        title = f"{row['agent']} explores {scene_name(episode.condition.scene)}"
        write_video(out / VIDEO, recording, title, on_progress)
    return row
