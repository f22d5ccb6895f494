"""List every reader of users' files: how a valid input is made, and what reads it."""

import gzip
import json
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from PIL import Image

from tests.helpers.dynamics.logs import circling, write_euroc
from tests.helpers.dynamics.transitions import random_transition
from tests.helpers.paths import CHECKOUT
from tests.helpers.straight_policy import straight
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.shared.planar.lstm_policy import LstmPolicy, load_lstm, save_lstm, size_of
from vssm_gym.data.datasets.recordings import read_recording
from vssm_gym.data.dynamics.read import read_dynamics
from vssm_gym.data.laser_logs import LaserLog, read_laser_log, write_laser_log
from vssm_gym.data.sequences import FrameReader, SequenceWriter, load_sequence
from vssm_gym.data.trajectories import read_trajectory
from vssm_gym.envs.robots.holonomic import HolonomicRobot
from vssm_gym.envs.scenes.generator import furnish_plan
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks import navigation
from vssm_gym.envs.tasks.habitat import habitat_file, write_habitat
from vssm_gym.envs.tasks.navigation import TaskSampler
from vssm_gym.eval.episodes.log import read_rows
from vssm_gym.eval.protocols.given_tasks import given_tasks
from vssm_gym.eval.report.page import write_report
from vssm_gym.eval.studies.calibration.errors import FilterErrors, RunErrors, summarise
from vssm_gym.eval.studies.calibration.stored import finished
from vssm_gym.eval.studies.calibration.table import study_of
from vssm_gym.eval.studies.maze_exploration.run import EXPLORATION_ROWS, read_exploration
from vssm_gym.eval.studies.page import write_study
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.eval.sweep.merge import merge_sweeps
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.scan_encoder.encoder_file import load_encoder, save_encoder
from vssm_gym.inference.scan_encoder.network import new_encoder
from vssm_gym.inference.scan_encoder.prior import VisitedPlaces
from vssm_gym.maps.latent_file import load_latent_grid, save_latent_grid
from vssm_gym.maps.latent_grid import ChartDecoder, LatentGrid
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition.learned_file import calibrated, load_transition, save_transition
from vssm_gym.training.config import load_training
from vssm_gym.training.learning_curves import read_training

ASSETS = CHECKOUT / "vssm_gym" / "envs" / "assets"
ROOM = [[0, 0], [5, 0], [5, 3], [3.2, 3], [3.2, 3.1], [5, 3.1], [5, 6], [0, 6], [0, 3.1], [2.2, 3.1], [2.2, 3], [0, 3]]


@dataclass(frozen=True)
class Reader:
    """Describe one kind of input.

    Attributes:
        make: writes a valid input into an empty folder.
        read: reads the input in that folder; returns anything, or raises InputError.
    """

    make: Callable[[Path], None]
    read: Callable[[Path], object]


def _scene_file(name: str, content: bytes | str) -> Callable[[Path], None]:
    data = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / name).write_bytes(data) and None


def _scene(name: str) -> Callable[[Path], object]:
    return lambda folder: load_scene(f"{folder / name}").boxes()


def _houses(folder: Path) -> None:
    """Write houses of ProcTHOR's format, one a line, with the database of their assets."""
    at = lambda x, y, z: {"x": x, "y": y, "z": z}
    rooms = [
        {
            "id": f"room|{i}",
            "roomType": "Bedroom",
            "floorPolygon": [at(x, 0, z) for x, z in ((4 * i, 0), (4 * i, 3), (4 * i + 4, 3), (4 * i + 4, 0))],
            "floorMaterial": {"name": "WoodFloorsCross"},
        }
        for i in (1, 2)
    ]
    walls = [
        {
            "id": f"wall|{i}|{k}",
            "roomId": room["id"],
            "polygon": [at(*a, 0), at(*b, 0), at(*a, 2.5), at(*b, 2.5)],
            "material": {"name": "PureWhite", "color": {"r": 0.2, "g": 0.3, "b": 0.9}},
        }
        for i, room in enumerate(rooms, 1)
        for k, (a, b) in enumerate(
            zip(_corners(room), [*_corners(room)[1:], _corners(room)[0]], strict=True)  # type: ignore[arg-type]
        )
    ]
    for wall in walls:
        for corner in wall["polygon"]:  # type: ignore[attr-defined]
            corner["y"], corner["z"] = corner["z"], corner["y"]
    table = {"id": "table", "assetId": "Table_1", "position": at(5, 0.45, 1), "rotation": at(0, 90, 0), "children": []}
    house = {"rooms": rooms, "walls": walls, "doors": [], "windows": [], "objects": [table], "metadata": {}}
    asset = {"assetId": "Table_1", "objectType": "DiningTable", "boundingBox": at(1.6, 0.8, 0.9)}
    (folder / "asset-database.json").write_text(json.dumps({"DiningTable": [asset]}))
    (folder / "houses.jsonl.gz").write_bytes(gzip.compress(2 * (json.dumps(house) + "\n").encode()))


def _corners(room: dict) -> list[tuple[float, float]]:
    return [(corner["x"], corner["z"]) for corner in room["floorPolygon"]]


def _ros_map(folder: Path) -> None:
    grey = np.full((50, 70), 205, np.uint8)
    grey[4:46, 4:66] = 0
    grey[5:45, 5:65] = 254
    grey[10:20, 12:22] = 0
    Image.fromarray(grey).save(folder / "map.png")
    settings = {"image": "map.png", "resolution": 0.1, "origin": [-2.0, 1.0, 0.0], "negate": 0}
    (folder / "map.yaml").write_text(yaml.safe_dump(settings | {"occupied_thresh": 0.65, "free_thresh": 0.196}))


def _mjcf(folder: Path) -> None:
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (folder / "mesh.obj").write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (folder / "more.xml").write_text(
        '<mujoco><worldbody><geom type="sphere" size=".2" pos="1 1 .2"/></worldbody></mujoco>'
    )
    (folder / "scene.xml").write_text(
        '<mujoco model="a"><compiler angle="degree"/><asset><mesh name="m" file="mesh.obj"/><material name="g" '
        'rgba=".2 .4 .6 1"/></asset><default><geom rgba="1 0 0 1"/></default><include file="more.xml"/><worldbody>'
        '<geom type="plane" size="5 5 .1"/><body pos="1 0 .3" euler="0 0 30"><freejoint/>'
        '<geom type="box" size=".2 .3 .25"/>'
        '</body><geom type="mesh" mesh="m" pos="-1 0 0" material="g"/><replicate count="3" offset="0 .5 0"><geom '
        'type="cylinder" size=".1 .2" pos="-2 0 .2"/></replicate></worldbody></mujoco>'
    )


def _map(slots: int | None) -> VoxelMap:
    m = VoxelMap.prior((0.0, 0.0, 0.0), 0.1, (16, 16, 8), slots=slots)
    return m


def _posterior(folder: Path) -> None:
    from vssm_gym.model.posterior import MANIFOLDS
    from vssm_gym.model.transition.belief import GaussianBelief

    manifold = MANIFOLDS["planar"]
    mean, n = manifold.resting(jnp.eye(4)), len(manifold.turns)
    Posterior(GaussianBelief(mean, 0.01 * jnp.eye(n), manifold), _map(None)).save(folder / "posterior.npz")


def _sequence(folder: Path) -> None:
    writer = SequenceWriter(folder / "sequence", Camera(16, 12, 9.0, 9.0, 8.0, 6.0), np.eye(4))
    rng, pose = np.random.default_rng(0), np.eye(4)
    for i in range(3):
        pose[0, 3] = 0.1 * i
        image = rng.integers(0, 255, (12, 16, 3), dtype=np.uint8)
        writer.append(0.1 * i, image, rng.uniform(0.5, 3.0, (12, 16)), pose, np.array([0.1, 0.0, 0.1]))
    writer.close()
    (folder / "sequence" / "imu.txt").write_text("".join(f"{0.01 * i:.2f} 0 0 0 0 0 9.81\n" for i in range(20)))


def _read_sequence(folder: Path) -> object:
    sequence = load_sequence(folder / "sequence")
    reader = FrameReader(sequence)
    return [reader[i] for i in range(min(len(reader), 5))], sequence.true_poses()


def _habitat(name: str) -> Callable[[Path], None]:
    """Return what writes five tasks of a scene as PointNav episodes."""

    def write(folder: Path) -> None:
        oak = load_scene("oak")
        tasks = navigation.task_set(oak, _robot(), "test", 5)
        write_habitat(habitat_file(tasks, TaskSampler(oak, _robot())), folder / name)

    return write


def _given(name: str) -> Callable[[Path], object]:
    return lambda folder: given_tasks(folder / name, load_scene("oak"))


def _laser_log(folder: Path) -> None:
    """Write three scans, with poses and a loop."""
    rng, of = np.random.default_rng(0), np.linspace(-1.5, 1.5, 6)
    triples = lambda n: rng.uniform(-1.0, 1.0, (n, 3))
    ranges = rng.uniform(0.1, 9.0, (3, 6)).astype(np.float32)
    log = LaserLog(ranges, of, 10.0, np.zeros(3), triples(2), triples(3), np.array([[0, 2]]), triples(1))
    write_laser_log(folder / "drive.log", log)


def _trajectory(name: str) -> Callable[[Path], None]:
    comma, scale = (",", 1_000_000_000) if name.endswith("csv") else (" ", 1)
    rows = [comma.join(map(str, (scale * i, i, 0.5, 0, 0, 0, 0, 1))) for i in range(20)]
    return _scene_file(name, "# time, position, quaternion\n" + "\n".join(rows) + "\n")


def _log(folder: Path) -> None:
    source = CHECKOUT / "eval" / "baselines" / "car"
    shutil.copy(source / "sweep.json", folder)
    rows = (source / "episodes.jsonl").read_text().splitlines(keepends=True)
    (folder / "episodes.jsonl").write_text("".join(rows[:5]))


def _exploration(folder: Path) -> None:
    source = CHECKOUT / "eval" / "baselines" / "maze_exploration" / EXPLORATION_ROWS
    (folder / "rows.jsonl").write_bytes(b"".join(source.read_bytes().splitlines(keepends=True)[:5]))


def _training_folder(folder: Path) -> None:
    config = {
        "name": "a",
        "seed": 0,
        "environment": {"num_envs": 4, "max_episode_steps": 25},
        "algorithm": {"name": "ppo"},
    }
    (folder / "training.json").write_text(
        json.dumps({"config": config, "world_hash": "0" * 16, "config_hash": "1" * 16})
    )
    row = {"seconds": 0.0, "steps": 0, "episodes": 9, "return": 1.0, "length": 9.0, "success": 0.5}
    rows = [row | {"seconds": 10.0 * i, "steps": 100 * i} for i in range(1, 9)]
    (folder / "progress.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def _shards(folder: Path) -> None:
    """Write the two shards of a sweep of four episodes."""
    source = CHECKOUT / "eval" / "baselines" / "car"
    manifest = json.loads((source / "sweep.json").read_text())
    rows = (source / "episodes.jsonl").read_text().splitlines(keepends=True)[:4]
    for index in (1, 2):
        shard = folder / f"shard{index}"
        shard.mkdir()
        (shard / "episodes.jsonl").write_text("".join(rows[index - 1 :: 2]))
        (shard / "sweep.json").write_text(json.dumps(manifest | {"episodes": 2, "shard": {"index": index, "of": 2}}))


def _merge(folder: Path) -> object:
    with tempfile.TemporaryDirectory() as scratch:
        return merge_sweeps([folder / "shard1", folder / "shard2"], Path(scratch) / "whole")


def _calibration(folder: Path) -> None:
    """Write the outcome of a study with one row, of a robot on the floor."""
    errors = FilterErrors(np.full((9, 3), 0.01), np.tile(1e-4 * np.eye(3), (9, 1, 1)), 9, 0, True)
    row = summarise(2 * [RunErrors(errors, (errors.last_nees,))]) | {"about": "a robot"}
    write_study(study_of({"robot": row}, {}, ()), folder)


SWEEP = (
    "env: vssm_gym/PointNav-v0\nscenes: [oak, elm]\nagents: [astar, random]\nnoise: [low, mid]\ntasks: 20-29\n"
    "seeds: 0\n"
)
TRAINING = (
    "name: corridor\nenvironment:\n  id: vssm_gym/PointNav-v0\n  scene: oak\n  num_envs: 4\nalgorithm:\n  name: ppo\n"
    "  n_steps: 32\npolicy:\n  hidden: [8, 8]\n  inputs: [scan, goal]\nsteps: 1000\n"
)


def _learned(folder: Path) -> None:
    transition = random_transition(calibrated("car"))
    save_transition(folder / "learned.npz", transition, "car", {"updates": 1})


_CHARTS = ChartDecoder(jnp.float32(0.5), jnp.eye(3, 6))
_PLACES = VisitedPlaces.of(np.array([[0.2, 0.3], [0.7, 0.6]]), 0.02)

READERS: dict[str, Reader] = {
    "scene": Reader(_scene_file("scene.json", (ASSETS / "oak.json").read_bytes()), _scene("scene.json")),
    "houseexpo": Reader(
        _scene_file("plan.json", json.dumps({"verts": ROOM, "room_category": {"Bedroom": [[0, 0, 5, 3]]}})),
        _scene("plan.json"),
    ),
    "furnished plan": Reader(
        _scene_file("plan.json", json.dumps({"verts": ROOM, "room_category": {"Bedroom": [[0, 0, 5, 3]]}})),
        lambda d: furnish_plan(load_scene(d / "plan.json"), 0).boxes(),
    ),
    "procthor": Reader(_houses, _scene("houses.jsonl.gz#1")),
    "ros map": Reader(_ros_map, _scene("map.yaml")),
    "mjcf": Reader(_mjcf, _scene("scene.xml")),
    "map": Reader(lambda d: _map(None).save(d / "map.npz"), lambda d: VoxelMap.load(d / "map.npz")),
    "sparse map": Reader(lambda d: _map(9).save(d / "map.npz"), lambda d: VoxelMap.load(d / "map.npz")),
    "posterior": Reader(_posterior, lambda d: Posterior.load(d / "posterior.npz")),
    "policy": Reader(
        lambda d: policy_file.save(d / "policy.npz", straight()), lambda d: policy_file.load(d / "policy.npz")
    ),
    "lstm policy": Reader(
        lambda d: save_lstm(d / "policy.npz", LstmPolicy(8, 4, np.zeros(size_of(8, 4)), np.zeros(8), np.ones(8))),
        lambda d: load_lstm(d / "policy.npz"),
    ),
    "maze exploration": Reader(
        _exploration,
        lambda d: read_exploration(d / "rows.jsonl"),
    ),
    "learned transition": Reader(_learned, lambda d: load_transition(d / "learned.npz")),
    "latent grid": Reader(
        lambda d: save_latent_grid(d / "charts.npz", LatentGrid.prior(np.zeros(2), np.ones(2), 0.5, _CHARTS)),
        lambda d: load_latent_grid(d / "charts.npz"),
    ),
    "scan encoder": Reader(
        lambda d: save_encoder(d / "encoder.npz", new_encoder(jax.random.key(0), 8, 1.5, _PLACES, 8, 2)),
        lambda d: load_encoder(d / "encoder.npz", _PLACES, 1.5),
    ),
    "euroc flight": Reader(lambda d: write_euroc(d, circling(1.0)) and None, read_dynamics),
    "tasks": Reader(
        lambda d: navigation.save(navigation.task_set(load_scene("oak"), _robot(), "test", 5), d / "tasks.json"),
        lambda d: navigation.load(d / "tasks.json"),
    ),
    "habitat": Reader(_habitat("val.json"), _given("val.json")),
    "habitat, packed": Reader(_habitat("val.json.gz"), _given("val.json.gz")),
    "sequence": Reader(_sequence, _read_sequence),
    "sequence as an episode": Reader(_sequence, lambda d: list(read_recording(d / "sequence", "0")[1].blocks)),
    "laser log": Reader(_laser_log, lambda d: read_laser_log(d / "drive.log").path()),
    "trajectory": Reader(_trajectory("poses.txt"), lambda d: read_trajectory(d / "poses.txt")),
    "trajectory, csv": Reader(_trajectory("poses.csv"), lambda d: read_trajectory(d / "poses.csv")),
    "sweep": Reader(_scene_file("sweep.yaml", SWEEP), lambda d: load_config(d / "sweep.yaml")),
    "training": Reader(_scene_file("training.yaml", TRAINING), lambda d: load_training(d / "training.yaml")),
    "episode log": Reader(_log, lambda d: read_rows(d / "episodes.jsonl")),
    "report": Reader(_log, lambda d: write_report(d, 0, d / "page.html")),
    "shards": Reader(_shards, _merge),
    "training folder": Reader(_training_folder, read_training),
    "calibration study": Reader(_calibration, lambda d: study_of(finished(d / "calibration.json", {}), {}, ())),
}


def _robot() -> HolonomicRobot:
    return HolonomicRobot()


def forget() -> None:
    """Free what JAX compiled for shapes that no other case has."""
    jax.clear_caches()
