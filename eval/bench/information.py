"""Measure the cost of an imagined step and how well its gain ranks candidates: ``bench information``.

Maps of a scene are learned from the first images of a survey, at true poses and without noise. Candidates are short
paths through free space that begin in known space. Each estimate is compared with the gain by all pixels and cells, and
with the gain of the true images at the same poses (thesis, section 5.6).
"""

import os
import platform
import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.stats import spearmanr

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.sensors import CameraConfig, SceneCamera, make_camera
from vssm_gym.envs.tasks.survey import survey_route
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.speed import CompileCounter
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix, wrap_angle
from vssm_gym.inference.mapping.map_update import update
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.planning.exploration.information import InformationConfig, entropy, expected_gain
from vssm_gym.planning.exploration.information.information_sum import gains
from vssm_gym.planning.exploration.information.observed import Grid, observed
from vssm_gym.progress import OnProgress

SURVEY_VOXEL = 0.07  # m
ROOM_MARGIN = 0.25  # m of the map beyond floor and ceiling
VIEWPOINTS = (1, 4, 12)  # of the survey, whose images the maps hold
SURVEY_HEADINGS = 8  # images a viewpoint
CANDIDATE_STEPS = 5  # of a candidate
LARGEST_TURN, LARGEST_STEP = 0.5, 0.25  # rad and m a step, at most
AIM_MS, AIM_RANK = 3.0, 0.95  # the project's own aims: ms a step, rank correlation
ALL = InformationConfig(pixels=None, every=1)
# Configuration, and surfaces expected in a metre of unknown space, 1/m.
ESTIMATES = {
    "default": (InformationConfig(), 0.0),
    "300 pixels": (InformationConfig(pixels=300), 0.0),
    "4,800 pixels": (InformationConfig(pixels=4800), 0.0),
    "19,200 pixels": (InformationConfig(pixels=None), 0.0),
    "default, every cell": (InformationConfig(every=1), 0.0),
    "all pixels and cells": (ALL, 0.0),
    "default, rays end at 4 m": (InformationConfig(max_depth=4.0), 0.0),
    "default, ground and 2 m of unknown": (InformationConfig(ground=0.0), 0.5),
    "default, 4 samples of the map": (InformationConfig(samples=4), 0.0),
}


def measure(*, scene: str, candidates: int, seed: int, on_progress: OnProgress | None = None) -> dict[str, Any]:
    """Measure times and rank correlations of every estimate, on maps of growing extent.

    Args:
        scene: built-in name or path.
        candidates: trajectories that are ranked on each map.
        seed: of the survey and of the candidates.
        on_progress: called with ("measuring", estimates done, total).

    Returns:
        ``rows`` of ``map`` (images in it), ``entropy`` (nats), ``what``, ``ms`` (a step), ``rank`` (Spearman's, with
        all pixels and cells), ``rank_true`` (with the true images' gain), ``ratio`` (median of estimate over truth);
        ``recompilations`` in calls with other candidates; the machine and its load before.

    Raises:
        InputError: a scene without known free space to start in.
    """
    apartment, robot = load_scene(scene), HolonomicRobot()
    scene_camera = make_camera(apartment.boxes(), CameraConfig())
    machine = {"cores": os.cpu_count(), "processor": platform.machine(), "load": round(os.getloadavg()[0], 1)}
    rng, rows, recompilations = np.random.default_rng(seed), [], 0
    poses = survey_poses(apartment, robot, seed)
    for i, viewpoints in enumerate(VIEWPOINTS):
        m = learned(apartment, scene_camera, poses[: viewpoints * SURVEY_HEADINGS])
        T = candidate_trajectories(m, apartment, robot, candidates, rng)
        exact, truth = expected_gain(m, T, scene_camera.camera, ALL).total, true_gain(m, T, scene_camera)
        for j, (what, (config, hazard)) in enumerate(ESTIMATES.items()):
            gain, ms, compiled = timed(m, T, scene_camera.camera, config, hazard)
            rank, rank_true = (float(spearmanr(gain, other).statistic) for other in (exact, truth))
            ratio = float(np.median(gain / truth))
            row = {"map": min(viewpoints * SURVEY_HEADINGS, len(poses)), "entropy": entropy(m), "what": what, "ms": ms}
            rows.append(row | {"rank": rank, "rank_true": rank_true, "ratio": ratio})
            recompilations += compiled
            if on_progress:
                on_progress("measuring", i * len(ESTIMATES) + j + 1, len(VIEWPOINTS) * len(ESTIMATES))
    scene_camera.close()
    found = {
        "scene": scene,
        "candidates": candidates,
        "steps": CANDIDATE_STEPS,
        "cells": int(np.prod(m.shape)),
        "rows": rows,
    }
    return found | {"aims": (AIM_MS, AIM_RANK), "recompilations": recompilations, "machine": machine}


def survey_poses(apartment: Apartment, robot: HolonomicRobot, seed: int) -> np.ndarray:
    """Return camera poses ``(images, 4, 4)``: a full turn at every viewpoint of a survey, in its order."""
    places = [(w.x, w.y) for w in survey_route(apartment, robot, seed) if w.turn_around]
    turns = np.arange(SURVEY_HEADINGS) * 2.0 * np.pi / SURVEY_HEADINGS
    return np.stack([planar_to_matrix(np.array([x, y, a])) @ robot.T_body_cam for x, y in places for a in turns])


def learned(apartment: Apartment, scene_camera: SceneCamera, poses: np.ndarray) -> VoxelMap:
    """Learn the map of the whole apartment from images at these poses."""
    corners = np.concatenate([np.array(room.polygon) for room in apartment.rooms])
    low = np.append(corners.min(axis=0), 0.0) - ROOM_MARGIN
    high = np.append(corners.max(axis=0), apartment.ceiling_height) + ROOM_MARGIN
    x, y, z = (int(n) for n in np.ceil((high - low) / SURVEY_VOXEL) + 1)
    m = VoxelMap.prior(low, SURVEY_VOXEL, (x, y, z))
    for T in poses:
        rgb, depth = scene_camera.render(T)
        colour = jnp.asarray(rgb, jnp.float32) / 255.0
        m = update(m, jnp.asarray(depth), colour, jnp.asarray(T, jnp.float32), scene_camera.camera, ALL.update)
    return m


def candidate_trajectories(
    m: VoxelMap, apartment: Apartment, robot: HolonomicRobot, n: int, rng: np.random.Generator
) -> np.ndarray:
    """Draw camera poses ``(n, CANDIDATE_STEPS, 4, 4)`` of paths from known free space.

    They turn, and stop before obstacles.
    """
    space = FreeSpace.from_apartment(apartment, robot.radius, robot.height)
    xy = space.sample(rng, 50 * n)
    centres = np.column_stack([xy, np.full(len(xy), robot.camera_height)])
    xy = xy[np.asarray(m.precision(jnp.asarray(centres, jnp.float32)))[:, 0] > OBSERVED_PRECISION][:n]
    if len(xy) < n:
        raise InputError(apartment.name, "floor", f"known free space around the survey's start for {n} candidates")
    heading = rng.uniform(-np.pi, np.pi, n)
    turn, poses = rng.uniform(-LARGEST_TURN, LARGEST_TURN, n), []
    for _ in range(CANDIDATE_STEPS):
        poses.append(planar_to_matrix(np.column_stack([xy, heading])) @ robot.T_body_cam)
        heading = wrap_angle(heading + turn)
        ahead = xy + LARGEST_STEP * np.column_stack([np.cos(heading), np.sin(heading)])
        xy = np.where(space.contains(ahead)[:, None], ahead, xy)
    return np.stack(poses, axis=1)


def true_gain(m: VoxelMap, T_world_cam: np.ndarray, scene_camera: SceneCamera) -> np.ndarray:
    """Compute the gain of the true images of the trajectories, nats: the same sum over the cells that they observe."""
    views = T_world_cam.reshape(-1, 4, 4)
    depth = np.stack([scene_camera.render(T)[1] for T in views])
    seen = observed(depth, views, scene_camera.camera, Grid.of(m), ALL.update, ALL.every)
    paths = np.arange(len(views)).reshape(T_world_cam.shape[:2])
    return gains(m, seen, paths, ALL.update.std**-2, ALL.every, ALL.known)[:, -1]


def timed(
    m: VoxelMap, T: np.ndarray, camera: Camera, config: InformationConfig, hazard: float
) -> tuple[np.ndarray, float, int]:
    """Return gains of the trajectories, ms a step, and the compilations after a first call with fewer of them."""
    expected_gain(m, T[:3], camera, config, hazard=hazard)
    counter, seconds = CompileCounter(), []
    for _ in range(3):
        began = time.perf_counter()
        found = expected_gain(m, T, camera, config, hazard=hazard)
        seconds.append(time.perf_counter() - began)
    return found.total, 1e3 * float(np.median(seconds)) / found.along.size, counter.count
