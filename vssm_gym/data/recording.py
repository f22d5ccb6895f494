"""Record a scene as a TUM folder (``vssm-gym record``): a robot's survey of it, or a hand-held camera's walk.

Driver and walker know the floor plan and the true pose; the recording contains images, commands and ground truth, as
from a motion-capture system. Agents get the map made from them, never the recording or the plan.
"""

import itertools
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.data.colour_rig import draw_rig, write_truth
from vssm_gym.data.handheld import walk
from vssm_gym.data.intrinsics import ColourCalibration
from vssm_gym.data.sequences import SequenceWriter
from vssm_gym.data.wandering import Wanderer
from vssm_gym.envs.pointnav import PointNavEnv
from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.robots.registry import HOLONOMIC_ROBOTS
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.sensors import CameraConfig, make_camera, rgbd_noise
from vssm_gym.envs.sensors.rgbd_noise import NoisySensor, SensorNoise
from vssm_gym.envs.simulation import Simulation
from vssm_gym.envs.streams import seeded_streams
from vssm_gym.envs.tasks.navigation import TaskSampler
from vssm_gym.envs.tasks.survey import Waypoint, survey_route
from vssm_gym.envs.validation import choose
from vssm_gym.errors import InputError
from vssm_gym.files.json_file import read_json
from vssm_gym.files.output_folders import check_new_folder, whole_folder
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import PARAMETERS, ColourCamera
from vssm_gym.geometry.transforms import R_BODY_CAM
from vssm_gym.planning.pursuit import steer
from vssm_gym.progress import OnProgress

PROVENANCE = "recording.json"  # beside TUM's files: scene and settings of the drive
COLOURS = ("registered", "unregistered")
LONGEST_DRIVE = 3600.0  # s of a drive by drawn commands
WAYPOINT_REACHED = 0.06  # m from a waypoint at which it counts as reached; about the noise of a step


def record(
    scene: str | Path,
    out: Path,
    *,
    robot: str = "holonomic",
    noise: str = "low",
    sensor_noise: str = "none",
    camera: CameraConfig | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> int:
    """Drive the survey route of ``scene`` and turn around once at each viewpoint; returns the number of frames.

    Args:
        scene: built-in name or path of a scene file.
        out: new or empty folder; written atomically.
        robot: that drives: a name of :data:`~vssm_gym.envs.robots.registry.HOLONOMIC_ROBOTS`.
        noise: execution noise of the drive; the recorded poses are the true ones.
        sensor_noise: what the camera adds to the exact image: a name of ``sensor_noise.PRESETS``.
        camera: size and angle of the images.
        seed: of the route and of both noises.
        on_progress: called with ("recording", waypoints passed, waypoints) after every waypoint.

    Raises:
        InputError: an unknown scene or noise, or a folder that is not empty.
    """
    check_new_folder(out)
    env = _environment(scene, robot, noise, sensor_noise, camera)
    route = survey_route(env.apartment, env.robot, seed)
    about = {"motion": "survey", "robot": robot, "noise": noise, "sensor_noise": sensor_noise}
    about |= {"renderer": env.renderer_name}
    try:
        with folder_for(out, env.apartment, about | {"seed": seed}) as unfinished:
            return _drive(env, route, unfinished, seed, on_progress)
    finally:
        env.close()


def record_wandering(
    scene: str | Path,
    out: Path,
    *,
    seconds: float = 300.0,
    robot: str = "holonomic",
    noise: str = "low",
    sensor_noise: str = "none",
    camera: CameraConfig | None = None,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> int:
    """Drive by drawn commands (:mod:`~vssm_gym.data.wandering`) from a drawn start; returns the number of frames.

    Args:
        scene: built-in name or path of a scene file.
        out: new or empty folder; written atomically.
        seconds: of the drive.
        robot: that drives: a name of :data:`~vssm_gym.envs.robots.registry.HOLONOMIC_ROBOTS`.
        noise: execution noise of the drive; the recorded poses are the true ones.
        sensor_noise: what the camera adds to the exact image: a name of ``sensor_noise.PRESETS``.
        camera: size and angle of the images.
        seed: of the start, the commands and of both noises.
        on_progress: called with ("recording", steps, all steps) now and then.

    Raises:
        InputError: an unknown scene or noise, an impossible duration, or a folder that is not empty.
    """
    check_new_folder(out)
    if not 1.0 <= seconds <= LONGEST_DRIVE:
        raise InputError("record", "seconds", f"a duration between 1 and {LONGEST_DRIVE:g} s, not {seconds}")
    env = _environment(scene, robot, noise, sensor_noise, camera)
    about = {"motion": "wander", "seconds": seconds, "robot": robot, "noise": noise, "sensor_noise": sensor_noise}
    steps = round(seconds / env.robot.dt)
    try:
        wanderer = Wanderer(env.apartment, env.robot, seed)
        with recorded_episode(env.simulation, out, about | {"seed": seed}) as write:
            observation, info = env.reset(seed=seed)
            write(observation, info)
            for k in range(steps):
                observation, _, _, _, info = env.step(np.append(wanderer(env.planar), 0.0))
                write(observation, info)
                if on_progress and (k % 20 == 0 or k + 1 == steps):
                    on_progress("recording", k + 1, steps)
    finally:
        env.close()
    return steps + 1


def _environment(
    scene: str | Path, robot: str, noise: str, sensor_noise: str, camera: CameraConfig | None
) -> PointNavEnv:
    """Return the environment of a robot whose drive is recorded."""
    choose("record", "robot", robot, HOLONOMIC_ROBOTS)
    return PointNavEnv(
        scene=str(scene),
        robot=robot,
        noise=noise,
        sensor_noise=sensor_noise,
        camera=camera,
        observe_pose=True,
        reward="sparse",
    )


def record_handheld(
    scene: str | Path,
    out: Path,
    *,
    metres: float = 50.0,
    rate: float = 10.0,
    sensor_noise: str = "none",
    camera: CameraConfig | None = None,
    colour: str = "registered",
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> int:
    """Carry a camera through ``scene`` (:func:`handheld.walk`); returns the number of frames.

    Args:
        scene: built-in name or path of a scene file.
        out: new or empty folder; written atomically.
        metres: length of the path at least.
        rate: frames a second.
        sensor_noise: what the camera adds to the exact image: a name of ``sensor_noise.PRESETS``.
        camera: size and angle of the images.
        colour: registered to depth, or unregistered: of a camera beside it, whose true calibration
            (:mod:`~vssm_gym.data.colour_rig`) is not the stated one.
        seed: of the path, of the sensor and of the true calibration.
        on_progress: called with ("recording", frames, total) now and then.

    Raises:
        InputError: an unknown scene or noise, an impossible length or rate, or a folder that is not empty.
    """
    check_new_folder(out)
    choose("record", "colour", colour, COLOURS)
    measured = rgbd_noise.sensor_noise(sensor_noise)
    apartment = load_scene(scene)
    path = walk(apartment, metres, rate, seed)
    eye = make_camera(apartment.boxes(), camera or CameraConfig())
    about = {"motion": "handheld", "metres": metres, "rate": rate, "body_radius": path.body}
    about |= {"sensor_noise": sensor_noise, "renderer": eye.name, "colour": colour, "seed": seed}
    T_body_cam = np.eye(4)
    T_body_cam[:3, :3] = R_BODY_CAM
    try:
        with folder_for(out, apartment, about) as unfinished:
            stated, true = draw_rig(eye.camera, seed) if colour == "unregistered" else (None, None)
            writer = SequenceWriter(unfinished, eye.camera, T_body_cam, controls=False, colour=stated)
            sensor = NoisySensor(measured, eye.camera, _sensor_stream(seed))
            beside = None if true is None else _Beside(apartment, true, measured, seed)
            for i, (time, T_world_cam) in enumerate(zip(path.times, path.T_world_cam, strict=True)):
                rgb, depth = sensor(*eye.render(T_world_cam), 1.0 / rate)
                if beside is not None:
                    rgb = beside(T_world_cam, 1.0 / rate)
                writer.append(time, rgb, depth, T_world_cam)
                if on_progress and (i % 20 == 0 or i + 1 == len(path.times)):
                    on_progress("recording", i + 1, len(path.times))
            writer.close()
            if true is not None:
                known = ColourCalibration(true, std=np.zeros(PARAMETERS))
                write_truth(unfinished, replace(writer.calibration, colour=known))
    finally:
        eye.close()
    return len(path.times)


class _Beside:
    """Render the images of a colour camera beside the depth camera, with an exposure and noise of their own."""

    def __init__(self, apartment: Apartment, colour: ColourCamera, noise: SensorNoise, seed: int) -> None:
        self._T_cam_colour = np.asarray(colour.T_depth_colour)
        self._eye = RaycastCamera(apartment.boxes(), colour.camera)
        self._sensor = NoisySensor(noise, colour.camera, seeded_streams(seed, ("colour",))["colour"])

    def __call__(self, T_world_cam: np.ndarray, dt: float) -> np.ndarray:
        """Return the colours seen from a pose of the depth camera, ``dt`` s after those before."""
        rgb, _ = self._sensor(*self._eye.render(T_world_cam @ self._T_cam_colour), dt)
        return rgb


@contextmanager
def recorded_episode(
    simulation: Simulation, out: Path, about: dict[str, Any]
) -> Iterator[Callable[[dict[str, np.ndarray], dict[str, Any]], None]]:
    """Yield a function that records each ``(observation, info)`` of an episode to ``out``.

    Args:
        simulation: of the robot, which the caller drives.
        out: new or empty folder; it appears where the block ends without an error.
        about: further fields of ``recording.json``.
    """
    check_new_folder(out)
    with folder_for(out, simulation.apartment, about | {"renderer": simulation.renderer.name}) as unfinished:
        writer = SequenceWriter(unfinished, simulation.camera, simulation.robot.T_body_cam)
        frames = itertools.count()

        def write(observation: dict[str, np.ndarray], info: dict[str, Any]) -> None:
            time = next(frames) * simulation.robot.dt
            writer.append(time, observation["rgb"], observation["depth"], info["T_world_cam"], info["control"])

        yield write
        writer.close()


@contextmanager
def folder_for(out: Path, apartment: Apartment, about: dict[str, Any]) -> Iterator[Path]:
    """Yield a folder to record into, which becomes ``out`` when complete, with its provenance beside the images."""
    provenance = {"scene": apartment.name, "scene_hash": apartment.content_hash(), **about}
    with whole_folder(out) as unfinished:
        yield unfinished
        (unfinished / PROVENANCE).write_text(json.dumps(provenance, indent=1) + "\n", encoding="utf-8")


def _sensor_stream(seed: int) -> np.random.Generator:
    """Return the sensor's own random stream, independent of path and drive."""
    return seeded_streams(seed)["sensors"]


def read_provenance(recording: Path) -> dict[str, Any]:
    """Read the provenance that :func:`record` wrote; empty for other folders."""
    try:
        found = read_json(recording / PROVENANCE)
    except InputError:
        return {}
    return found if isinstance(found, dict) else {}


def _drive(
    env: PointNavEnv,
    route: list[Waypoint],
    folder: Path,
    seed: int,
    on_progress: OnProgress | None,
) -> int:
    """Follow the route from its first waypoint and write every image; returns how many."""
    ahead = next((w for w in route[1:]), route[0])
    heading = float(np.arctan2(ahead.y - route[0].y, ahead.x - route[0].x))
    sampler = TaskSampler(env.apartment, env.robot)
    task = sampler.task((route[0].x, route[0].y, heading), (route[-1].x, route[-1].y))
    observation, info = env.reset(seed=seed, options={"task": task})
    camera = Camera.from_matrix(info["K"], env.camera.width, env.camera.height)
    writer = SequenceWriter(folder, camera, env.robot.T_body_cam)
    frames = 0

    def write() -> None:
        nonlocal frames
        images = observation["rgb"], observation["depth"]
        writer.append(frames * env.robot.dt, *images, info["T_world_cam"], info["control"])
        frames += 1

    def command(turn: float, offset: float, step: float) -> None:
        nonlocal observation, info
        observation, _, _, _, info = env.step(np.array([turn, offset, step, 0.0]))
        write()

    write()
    limits = env.robot.limits
    for i, waypoint in enumerate(route):
        target = np.array([waypoint.x, waypoint.y])
        # A robot pushed behind a corner by noise slides along it; if it cannot pass, it drives to the next waypoint.
        for _ in range(_patience(env.planar[:2], target, limits)):
            if np.hypot(*(env.planar[:2] - target)) < WAYPOINT_REACHED:
                break
            command(*steer(env.planar, np.array([env.planar[:2], target]), limits))
        if waypoint.turn_around:
            for _ in range(int(np.ceil(2.0 * np.pi / limits[0]))):
                command(limits[0], 0.0, 0.0)
        if on_progress:
            on_progress("recording", i + 1, len(route))
    writer.close()
    return frames


def _patience(xy: np.ndarray, target: np.ndarray, limits: np.ndarray) -> int:
    """Return the number of steps after which a leg is given up: twice those of a half turn and of the straight line."""
    return int(2 * np.ceil(np.pi / limits[0]) + 2 * np.ceil(np.hypot(*(target - xy)) / limits[2]))
