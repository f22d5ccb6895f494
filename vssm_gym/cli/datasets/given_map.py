"""Check the map that agents of `vssm-gym dataset export` are given: a map of another scene would lose them."""

import warnings
from collections.abc import Collection
from pathlib import Path

import numpy as np

from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.faults import SceneWarning
from vssm_gym.envs.scenes.generator import recorded_spec
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.envs.tasks.navigation import task_set
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols.registry import protocol_of
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.given_map import given_map_hash
from vssm_gym.eval.video.navigator_run import CHECKED_TASKS, IMAGENAV, POINTNAV, map_notice
from vssm_gym.files.shipped import ASSETS, MAPS, shipped
from vssm_gym.maps.voxel_map import VoxelMap, read_metadata


def check_given_map(config: SweepConfig, given: Path) -> str | None:
    """Return what the user should know of a map before its agents drive; None where there is nothing to say.

    A map that comes with the package is of the scene that has its name. The map of a sweep or of an explorer states the
    hash of its scene; where obstacles were moved after the recording, that of the scene before. One of `vssm-gym map
    build` states no scene: it is looked at as `vssm-gym navigate` does.

    Args:
        config: of the episodes.
        given: file of the map, or the name of one that comes with the package.

    Raises:
        InputError: a configuration of several scenes, no map in a scene's frame, or a map of another scene.
    """
    file = shipped(given, MAPS)
    given_map_hash(config, file)
    (scene,) = config.scenes
    if file.resolve().parent == (ASSETS / MAPS).resolve() and scene_name(scene) != file.stem:
        expected = f"a configuration of scene {file.stem}, of which this map is; found {scene_name(scene)}"
        raise InputError(given, "scene", expected)
    stated = read_metadata(file).get("scene_hash")
    if stated is not None:
        _check_hash(given, scene, stated, {_hash(config.env[0], one) for one in (scene, recorded_spec(scene))})
        return None
    return _notice(file, scene) if config.env[0] in (POINTNAV, IMAGENAV) else None


def _check_hash(given: Path, scene: str, stated: object, known: Collection[str]) -> None:
    if stated not in known:
        expected = f"a map of scene {scene_name(scene)} ({', '.join(sorted(known))}); this one is of {stated!r:.80}"
        raise InputError(given, "scene_hash", expected)


def _hash(env: str, scene: str) -> str:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # the command prints them as notices
        return protocol_of(env).load(scene).content_hash()


def _notice(file: Path, scene: str) -> str | None:
    """Return what to say of a map that shows obstacles where the robot of PointNav fits in the scene."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)
        known = task_set(load_scene(scene), HolonomicRobot(), "test", CHECKED_TASKS).tasks
    places = np.array([xy for task in known for xy in (task.start[:2], task.goal)])
    return map_notice(VoxelMap.load(file), known[0].start, places)
