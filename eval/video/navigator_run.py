"""Drive one navigation task with one agent, and keep its row, the map that it built, a picture and a video."""

import hashlib
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from vssm_gym.agents.base import ANY_TASK
from vssm_gym.agents.policy.policy_file import PREFIX as POLICY
from vssm_gym.agents.registry import AGENTS, WITH, agent_type, make_agent
from vssm_gym.data.images import colour_image
from vssm_gym.envs.robots import HOLONOMIC_NOISES, HolonomicRobot
from vssm_gym.envs.scenes.faults import SceneWarning
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.envs.tasks.navigation import SHIPPED_TASKS, Task, task_set
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.episodes.identity import Episode, episode_seed, scene_name
from vssm_gym.eval.protocols.episode import StepRecord, run_episode
from vssm_gym.eval.protocols.explore_episode import map_of
from vssm_gym.eval.protocols.shared import sampler_of, world
from vssm_gym.eval.sweep.config import OF_ONE, SweepConfig, check_names, expand
from vssm_gym.eval.sweep.given_map import scene_map_hash
from vssm_gym.eval.sweep.manifest import config_hash
from vssm_gym.eval.video import navigator_pictures
from vssm_gym.eval.video.ending import Ending
from vssm_gym.eval.video.given_image import GivenImage, unjudged
from vssm_gym.eval.video.navigator import write_video
from vssm_gym.eval.video.navigator_recording import Recording
from vssm_gym.eval.video.run_files import PICTURE, VIDEO, write_map, write_picture, write_row
from vssm_gym.files.output_folders import Owner, check_at_least, owned_folder
from vssm_gym.files.shipped import MAPS, or_shipped, shipped
from vssm_gym.instruction_set import cpu_model
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.progress import OnProgress
from vssm_gym.version import package_version

POINTNAV, IMAGENAV = "vssm_gym/PointNav-v0", "vssm_gym/ImageNav-v0"
MANIFEST = "navigate.json"
IDENTITY = ("config_hash", "start", "goal", "steps", "map_hash")  # of a run; fields of the manifest
COMMAND = "navigate"  # source of errors about the arguments
START_HEIGHT = 0.3  # m, of the robot's body, at which the map has to show the start as free
CHECKED_TASKS, MOST_OCCUPIED = 40, 0.05  # whose starts and goals are free in the scene, and the share that may not be


@dataclass(frozen=True)
class Drive:
    """Describe one run.

    Attributes:
        scene: built-in name, ``procedural:SEED`` or path of a scene file.
        goal: x, y (m) of the goal, or the file of an image that was taken there; None: that of ``task``.
        agent: a name of the registry, of the task ``pointgoal`` or ``imagegoal``, or an agent that reads no goal.
        start: x, y (m), heading (rad); None: that of ``task``.
        map: file or name of the map that the agent is given; None for an agent that needs none.
        noise: of execution.
        sensor_noise: of the camera.
        seed: of the noise and of the agent.
        steps: time limit.
        task: number of the scene's test task that has what is not given.
    """

    scene: str
    goal: tuple[float, float] | Path | None
    agent: str
    start: tuple[float, float, float] | None = None
    map: Path | None = None
    noise: str = "low"
    sensor_noise: str = "none"
    seed: int = 0
    steps: int = 500
    task: int = 0


@dataclass(frozen=True)
class Prepared:
    """Hold a run whose arguments were checked: the episode of a sweep, its task, its map and the image of its goal."""

    drive: Drive
    episode: Episode
    task: Task
    scene_hash: str
    voxel_map: VoxelMap | None
    image: np.ndarray | None
    manifest: dict[str, Any]
    notice: str | None  # what the user should know before the run


def prepare(drive: Drive) -> Prepared:
    """Check what is to be run, and set its task.

    Raises:
        InputError: an unknown name, an agent of another task, a map that is missing or not used, a start or goal where
            the robot does not fit, a goal that is reached at the start, an image that cannot be the camera's.
    """
    check_at_least(COMMAND, "seed", drive.seed, 0)
    check_at_least(COMMAND, "steps", drive.steps, 1)
    check_at_least(COMMAND, "task", drive.task, 0)
    if drive.task >= SHIPPED_TASKS:
        raise InputError(COMMAND, "task", f"less than {SHIPPED_TASKS}; found {drive.task}")
    kind = AGENTS.get(drive.agent.partition(WITH)[0])
    if kind is None and not drive.agent.startswith(POLICY):
        raise InputError(COMMAND, "agent", one_of((*navigators(), f"{POLICY}FILE"), drive.agent))
    by_image = isinstance(drive.goal, Path) or (kind is not None and kind.task == "imagegoal")
    config = SweepConfig(
        env=(IMAGENAV if by_image else POINTNAV,),
        scenes=(drive.scene,),
        agents=(drive.agent,),
        noise=(drive.noise,),
        sensor_noise=(drive.sensor_noise,),
        tasks=(drive.task,),
        seeds=(drive.seed,),
    )
    check_names(config, COMMAND, OF_ONE)
    map_file = _map_file(drive, agent_type(drive.agent).needs_map)
    map_hash = None if map_file is None else scene_map_hash(map_file)
    image = _image(drive.goal) if isinstance(drive.goal, Path) else None
    (episode,) = expand(config)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # commands print them as notices
        apartment = load_scene(drive.scene)
        task, content = _task(drive, apartment), apartment.content_hash()
    manifest = {
        "config": config.model_dump(mode="json"),
        "config_hash": config_hash(config, {drive.scene: content}, 0),
        "start": list(task.start),
        "goal": list(task.goal) if image is None else hashlib.sha256(image.tobytes()).hexdigest()[:16],
        "steps": drive.steps,
        "map_hash": map_hash,
        "version": package_version(),
    }
    voxel_map = None if map_file is None else VoxelMap.load(map_file)
    notice = None
    if voxel_map is not None:
        known = task_set(apartment, HolonomicRobot(), "test", CHECKED_TASKS).tasks
        notice = map_notice(voxel_map, task.start, np.array([xy for one in known for xy in (one.start[:2], one.goal)]))
    return Prepared(drive, episode, task, content, voxel_map, image, manifest, notice)


def navigate(
    prepared: Prepared, out: Path, video: bool = True, on_progress: OnProgress | None = None
) -> dict[str, Any]:
    """Run one episode and write the folder ``out``: map, row and picture first, the video last.

    A run that is interrupted in its video leaves what it has written; the same run may use the folder again.

    Args:
        prepared: what to run.
        out: new or empty folder, or that of an unfinished run of the same; see ``vssm-gym navigate --help``.
        video: False where no video can be written.
        on_progress: called with ("navigating" | "video", done, total).

    Returns:
        The row of a sweep of this task, whose number is 0; with None for what an image of the goal leaves unknown.

    Raises:
        InputError: the folder of another run, or of one that has ended.
        OutputError: a full disk or the like.
    """
    owner = Owner("navigation", MANIFEST, prepared.manifest, IDENTITY, finished=finished_by(video))
    with owned_folder(out, owner), warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        return _navigate(prepared, out, video, on_progress)


def finished_by(video: bool) -> str:
    """Return the file that a run writes last."""
    return VIDEO if video else PICTURE


def navigators() -> list[str]:
    """Return the names of the agents that drive to a place or to an image, or without a goal."""
    tasks = ("pointgoal", "imagegoal", ANY_TASK)
    return sorted(name for name, kind in AGENTS.items() if kind.robot == "holonomic" and kind.task in tasks)


def _image(path: Path) -> UInt8[np.ndarray, "height width 3"]:
    """Read the image of a goal, of the size of the robot's camera."""
    image, camera = colour_image(path, None), CameraConfig()
    height, width = image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        expected = f"{camera.width}x{camera.height} pixels, as of the robot's camera; found {width}x{height}"
        raise InputError(path, "size", expected)
    return image


def _map_file(drive: Drive, needed: bool) -> Path | None:
    """Return the file of the map; raise :class:`InputError` where the agent lacks one, or has no use for it."""
    if needed and drive.map is None:
        expected = f"a map of `vssm-gym map build`{or_shipped(MAPS)}; {drive.agent} needs one"
        raise InputError(COMMAND, "map", expected)
    if not needed and drive.map is not None:
        raise InputError(COMMAND, "map", f"none with {drive.agent}, an agent that is given no map; found {drive.map}")
    return None if drive.map is None else shipped(drive.map, MAPS)


def map_notice(voxel_map: VoxelMap, start: tuple[float, float, float], free: np.ndarray) -> str | None:
    """Return what to say of a map that does not show free places of the scene as free; None of others.

    Args:
        voxel_map: that the agent is given.
        start: of the task, x, y (m), heading (rad).
        free: places where the robot fits in the scene, ``(n, 2)`` m.
    """
    places = np.concatenate([[start[:2]], free])
    p = jnp.asarray(np.column_stack([places, np.full(len(places), START_HEIGHT)]), jnp.float32)
    seen = np.asarray(jax.vmap(lambda one: voxel_map.precision(one)[0])(p)) > OBSERVED_PRECISION
    occupied = seen & (np.asarray(jax.vmap(voxel_map.occupancy_at)(p)) >= 0.0)
    where = f"({start[0]:.2f}, {start[1]:.2f})"
    if occupied[0] or not seen[0]:
        what = "an obstacle" if seen[0] else "nothing"
        return f"the map shows {what} at the start {where}: is it a map of this scene?"
    if occupied.mean() > MOST_OCCUPIED:
        found = f"{occupied.sum()} of {len(free)} places where the robot fits in this scene"
        return f"the map shows obstacles at {found}: is it a map of this scene?"
    return None


def _task(drive: Drive, apartment: Apartment) -> Task:
    """Return the task; one with an image for its goal has the goal of a test task as a stand-in."""
    sampler = sampler_of(drive.scene)
    known = task_set(apartment, HolonomicRobot(), "test", max(drive.task + 1, 2)).tasks
    given, other = known[drive.task], known[drive.task - 1]
    start = given.start if drive.start is None else drive.start
    try:
        if isinstance(drive.goal, Path):  # of two goals that far apart, a start is at one at most
            tasks = [sampler.task(start, task.goal) for task in (given, other)]
            return max(tasks, key=lambda task: task.geodesic)
        task = sampler.task(start, given.goal if drive.goal is None else drive.goal)
    except InputError as error:
        raise InputError(COMMAND, error.field, error.expected) from None
    if task.geodesic <= 0.0:
        x, y, _ = task.start
        raise InputError(COMMAND, "goal", f"a place that is not reached already at the start ({x:.2f}, {y:.2f})")
    return task


def _navigate(prepared: Prepared, out: Path, video: bool, on_progress: OnProgress | None) -> dict[str, Any]:
    """Do the work of :func:`navigate` in a folder that it owns."""
    drive, episode, image = prepared.drive, prepared.episode, prepared.image
    agent, noise = make_agent(episode.agent), HOLONOMIC_NOISES[episode.condition.noise]
    recording = Recording(agent, prepared.voxel_map)

    def see(step: StepRecord) -> None:
        recording(step)
        if on_progress:
            on_progress("navigating", step.number, drive.steps)

    env = world(episode.condition, observe_pose=agent.needs_pose, max_episode_steps=drive.steps)
    result = run_episode(
        env if image is None else GivenImage(env, image),
        sampler_of(drive.scene),
        agent,
        prepared.task,
        seed=episode_seed(episode.seed, prepared.scene_hash, episode.task),
        voxel_map=prepared.voxel_map,
        noise=noise,
        spectator=see,
    )
    if on_progress:
        on_progress("navigating", result["steps"], result["steps"])
    signature = {name: prepared.manifest[name] for name in ("version", "config_hash", "map_hash")}
    signature["processor"] = cpu_model()
    row = episode.identity(prepared.scene_hash) | signature | (result if image is None else unjudged(result))
    own = map_of(agent)
    if own is not None:
        write_map(out, own, row)
    write_row(out, row)
    shown = prepared.voxel_map if own is None else own
    write_picture(out / PICTURE, navigator_pictures.run(recording, shown, row))
    if video:
        title = f"{row['agent']} drives through {scene_name(drive.scene)}"
        write_video(out / VIDEO, recording, Ending.of(row), title, on_progress)
    return row
