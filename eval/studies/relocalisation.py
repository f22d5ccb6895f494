"""Measure relocalisation: how often is a robot found on a floor from nowhere, how often wrongly, and how fast?

Poses are drawn uniformly in the free space of a scene, headings too. At each of them the camera takes one image, exact
or with the noise of a sensor, and the robot is looked for in the learned map of the scene without any prior. A *wrong*
acceptance is farther than ``RIGHT_POSE`` from the truth. A picture, the exact colours of a view without depth, is
looked for as well: ImageNav's goal images are such pictures.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vssm_gym.agents.shared.map_index import SPACING, free_places
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.sensors.camera import CameraConfig, make_camera
from vssm_gym.envs.sensors.rgbd_noise import NoisySensor, sensor_noise
from vssm_gym.eval.studies.page import Study
from vssm_gym.geometry.transforms import planar_to_matrix, wrap_angle
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.relocalisation.relocaliser import Found, Outcome, Relocaliser
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.progress import OnProgress
from vssm_gym.slam.map_building import ensure_map
from vssm_gym.viz import pictures

RIGHT_POSE = (0.1, np.radians(5.0))  # m, rad: a pose within both is right
LEARNED_VOXEL = 0.05  # m, of the learned maps
PLAIN = 0.04  # standard deviation of the luminance below which a view has no texture
LEAST_DEPTH = 0.5  # m, median depth below which a view is a surface in front of the lens
OPEN = 1.0  # m, median depth of a picture at least, as of ImageNav's goals
PICTURE = "picture"  # the row of images without depth
HEADINGS = 8  # tried for a picture that is open


@dataclass(frozen=True)
class Query:
    """Hold the outcome of one image."""

    scene: str
    sensor: str
    textured: bool  # neither plain nor close
    outcome: str
    hypotheses: int
    metres: float | None  # from the truth, of the likeliest hypothesis
    radians: float | None
    seconds: float

    @property
    def right(self) -> bool:
        """Return True where the likeliest hypothesis is right."""
        return self.metres is not None and self.metres <= RIGHT_POSE[0] and (self.radians or 0.0) <= RIGHT_POSE[1]


def run(
    scenes: Sequence[str],
    folder: Path,
    *,
    sensors: Sequence[str],
    poses: int,
    seed: int = 0,
    on_progress: OnProgress | None = None,
) -> Study:
    """Look for a robot at random poses of every scene, with every sensor.

    Args:
        scenes: built-in names or paths.
        folder: for the maps of the scenes, which are kept and used again.
        sensors: noise of the camera: ``none``, ``kinect``, ``stereo``.
        poses: of every scene.
        seed: of the drives that the maps are learned from, and of the poses.
        on_progress: called after every image.
    """
    queries: list[Query] = []
    index: dict[str, dict[str, float]] = {}
    for scene in scenes:
        m = VoxelMap.load(ensure_map(scene, folder, voxel=LEARNED_VOXEL, seed=seed, on_progress=on_progress))
        queries += _measured(scene, m, sensors, poses, seed, index, on_progress)
    rows = {sensor: [q for q in queries if q.sensor == sensor] for sensor in (*sensors, PICTURE)}
    figures = {sensor: _figures(of) for sensor, of in rows.items()}
    return Study(
        name="relocalisation",
        question="Is a robot found on the floor from nowhere?",
        answer=_answer(figures),
        header=("image", "images", "found", "ambiguous", "nothing fits", "wrong", "median error", "median time"),
        lines=[[sensor, *_line(values)] for sensor, values in figures.items()],
        picture=_picture(rows),
        setting={"scenes": list(scenes), "sensors": list(sensors), "poses": poses, "seed": seed, "spacing": SPACING},
        figures={"by_image": figures, "index": index, "queries": [asdict(q) for q in queries]},
        notes=(
            f"Found: accepted, within {RIGHT_POSE[0]:g} m and {np.degrees(RIGHT_POSE[1]):.0f} degrees of the truth. "
            "Wrong: accepted elsewhere. Views are textured where the exact image varies by "
            f"{PLAIN:g} in luminance and has a median depth of {LEAST_DEPTH:g} m; the others are in the figures only.",
            f"A picture has colours alone, and a median depth of {OPEN:g} m where one of {HEADINGS} headings has it, "
            "as goal images do. For it, found counts the likeliest place, whether others look alike or not.",
        ),
    )


def _measured(
    scene: str,
    m: VoxelMap,
    sensors: Sequence[str],
    poses: int,
    seed: int,
    index: dict[str, dict[str, float]],
    on_progress: OnProgress | None,
) -> list[Query]:
    """Return the outcomes of one scene."""
    robot, config, apartment = HolonomicRobot(), CameraConfig(), load_scene(scene)
    camera = make_camera(apartment.boxes(), config)
    rng = np.random.default_rng([seed, 43])
    drawn = FreeSpace.from_apartment(apartment, robot.radius, robot.height).sample(rng, poses)
    places = free_places(ClearanceMap.from_voxel_map(m), robot.radius)
    began = time.perf_counter()
    relocaliser = Relocaliser.of(m, Rig.of(config.intrinsics(), robot.T_body_cam), places)
    index[scene] = {"places": len(places), "seconds": time.perf_counter() - began}
    noisy = {
        name: NoisySensor(sensor_noise(name), camera.camera, np.random.default_rng([seed, 44])) for name in sensors
    }
    queries = []
    look = lambda planar: camera.render(planar_to_matrix(planar) @ robot.T_body_cam)
    for number, xy in enumerate(drawn, 1):
        planar = np.array([*xy, rng.uniform(-np.pi, np.pi)])
        rgb, depth = look(planar)
        textured = float(rgb.mean(-1).std()) / 255.0 >= PLAIN and float(np.median(depth)) >= LEAST_DEPTH
        for name, sensor in noisy.items():
            image = RGBD.from_camera(*sensor(rgb, depth, 10.0))  # s, after which the exposure is another one
            began = time.perf_counter()
            found = relocaliser.find(image)
            queries.append(_query(scene, name, textured, found, planar, time.perf_counter() - began))
        views = []
        for heading in planar[2] + 2.0 * np.pi * np.arange(HEADINGS) / HEADINGS:
            view = np.array([*xy, heading])
            rgb, depth = look(view)
            views.append((float(np.median(depth)), rgb, view))
            if views[-1][0] >= OPEN:
                break
        _, rgb, view = max(views, key=lambda v: v[0])
        began = time.perf_counter()
        found = relocaliser.find_picture(rgb.astype(np.float32) / 255.0)
        queries.append(_query(scene, PICTURE, True, found, view, time.perf_counter() - began))
        if on_progress:
            on_progress(scene, number, poses)
    camera.close()
    return queries


def _query(scene: str, sensor: str, textured: bool, found: Found, truth: np.ndarray, seconds: float) -> Query:
    metres = radians = None
    if found.hypotheses:
        off = found.hypotheses[0].planar - truth
        metres, radians = float(np.hypot(*off[:2])), abs(float(wrap_angle(off[2])))
    return Query(scene, sensor, textured, found.outcome.value, len(found.hypotheses), metres, radians, seconds)


def _figures(queries: Sequence[Query]) -> dict[str, Any]:
    """Return shares among the textured views, and among all."""

    def shares(of: Sequence[Query]) -> dict[str, Any]:
        n = max(len(of), 1)
        accepted = [q for q in of if q.outcome == Outcome.FOUND.value]
        right = [q for q in of if q.right and (q.sensor == PICTURE or q in accepted)]
        errors = [q.metres for q in right if q.metres is not None]
        return {
            "images": len(of),
            "found": len(right) / n,
            "ambiguous": sum(q.outcome == Outcome.AMBIGUOUS.value for q in of) / n,
            "nothing": sum(q.outcome == Outcome.NOTHING.value for q in of) / n,
            "wrong": sum(not q.right for q in accepted) / n,
            "median_error": float(np.median(errors)) if errors else None,
            "median_seconds": float(np.median([q.seconds for q in of])) if of else None,
        }

    return {"textured": shares([q for q in queries if q.textured]), "all": shares(queries)}


def _line(values: dict[str, Any]) -> list[str]:
    v = values["textured"]
    error, seconds = v["median_error"], v["median_seconds"]
    return [
        str(v["images"]),
        *(f"{v[name]:.1%}" for name in ("found", "ambiguous", "nothing", "wrong")),
        "-" if error is None else f"{1e3 * error:.0f} mm",
        "-" if seconds is None else f"{1e3 * seconds:.0f} ms",
    ]


def _answer(figures: dict[str, dict[str, Any]]) -> str:
    parts = [
        f"{name}: {v['textured']['found']:.1%} of {v['textured']['images']} are found, {v['textured']['wrong']:.1%} "
        f"are accepted at a wrong place"
        for name, v in figures.items()
    ]
    return "Of textured views, " + "; ".join(parts) + "."


def _picture(rows: dict[str, list[Query]]) -> bytes:
    """Draw the distribution of the errors of the likeliest place, as SVG."""
    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    axes = figure.subplots()
    for name, queries in rows.items():
        errors = np.sort([np.inf if q.metres is None else q.metres for q in queries if q.textured])
        if len(errors):
            axes.step(errors, np.arange(1, len(errors) + 1) / len(errors), where="post", label=name)
    axes.set(xscale="log", xlim=(1e-3, 20.0), ylim=(0.0, 1.0), xlabel="m from the truth, likeliest place")
    axes.set_ylabel("share of the textured views")
    axes.grid(alpha=0.3)
    axes.legend()
    axes.spines[["top", "right"]].set_visible(False)
    return pictures.svg(figure)
