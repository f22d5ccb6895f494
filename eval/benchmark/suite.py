"""Read a suite: its tracks, each with its tasks and score, and the hashes by which these are known to be unchanged.

A suite is a file. Its scenes and tasks are computed anew before anything runs and compared with what the file states,
so that two tables of ``small-v1`` are of the same tasks. A suite that changes gets another name.
"""

import hashlib
import json
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
import yaml
from pydantic import AfterValidator, Field

from vssm_gym.envs.scenes.content_hash import content_hash
from vssm_gym.envs.scenes.generator import PREFIX
from vssm_gym.envs.scenes.scene import built_in_scenes, load_scene
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.envs.validation import StrictModel, validated
from vssm_gym.errors import InputError, one_of
from vssm_gym.eval.benchmark.rules import rules_hash
from vssm_gym.eval.protocols.registry import protocol_of
from vssm_gym.eval.sweep.config import SweepConfig, check_environments
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.json_file import read_json
from vssm_gym.files.shipped import MAPS, shipped
from vssm_gym.files.yaml_file import printable, read_yaml
from vssm_gym.maps.map_file import map_hash

SUITES = Path(__file__).parent / "suites"
NEWEST = {"small": "small-v1", "full": "full-v1"}
ANYONE = ("random",)  # agents of a track's sweep until an entry takes their place
PLACE_DIGITS = 4  # of positions in metres and angles in radians that are hashed: tasks are drawn to 0.1 mm

Text = Annotated[str, AfterValidator(printable)]
Seconds = Annotated[float, Field(gt=0.0, le=36_000.0)]
Sensor = Literal["none", "kinect", "stereo"]


class DrivingTrack(StrictModel):
    """Define a track of agents: the episodes of a sweep, without its agents.

    ``map`` names a map that comes with the package; without it, maps are learned. ``unmapped`` admits only agents that
    need no map. ``pose`` says whether agents that observe the true pose are ranked (``observed``) or stand apart.
    ``seconds`` of processor time an agent may use in an episode.
    """

    kind: Literal["driving"]
    about: Text
    score: Literal["spl", "timely", "explored"]
    sweep: dict[str, Any]
    map: Text | None = None
    unmapped: bool = False
    pose: Literal["estimated", "observed"] = "estimated"
    seconds: Seconds

    def config(self, agents: tuple[str, ...] = ANYONE, folder: Path = Path()) -> SweepConfig:
        """Return the sweep with these agents; scene files are relative to ``folder``."""
        config = validated(SweepConfig, self.sweep | {"agents": agents}, "suite", "sweep")
        check_environments(config, "suite")
        names = protocol_of(config.env[0]).scene_names()
        known = lambda scene: scene in names or scene.startswith(PREFIX)
        scenes = tuple(scene if known(scene) else str((folder / scene).resolve()) for scene in config.scenes)
        return config.model_copy(update={"scenes": scenes})


class Recording(StrictModel):
    """Define a recording for SLAM: a camera is carried for some metres, or a robot drives for some seconds."""

    scene: Text
    motion: Literal["handheld", "wander"]
    length: Annotated[float, Field(gt=0.0, le=1000.0)]  # m of a walk, s of a drive
    noise: Literal["none", "low", "mid", "high"] = "mid"  # of a robot's execution
    sensor_noise: Sensor = "kinect"
    seed: Annotated[int, Field(ge=0)] = 0

    @property
    def name(self) -> str:
        """Return a name for files and rows, which tells all fields."""
        noise = f"-{self.noise}" if self.motion == "wander" else ""
        return f"{scene_name(self.scene)}-{self.motion}-{self.length:g}{noise}-{self.sensor_noise}-{self.seed}"


def located(scene: str, folder: Path) -> str:
    """Return a scene as it is loaded: a built-in name, a seed, or a file that is relative to the suite's folder."""
    return scene if scene in built_in_scenes() or scene.startswith(PREFIX) else str((folder / scene).resolve())


class SlamTrack(StrictModel):
    """Define a track of SLAM methods; ``seconds`` of processor time a method may use for a recording."""

    kind: Literal["slam"]
    about: Text
    recordings: Annotated[tuple[Recording, ...], Field(min_length=1)]
    seconds: Seconds

    def located(self, folder: Path) -> tuple[Recording, ...]:
        """Return the recordings with scenes as they are loaded; raise :class:`InputError` for two of one name."""
        found = tuple(one.model_copy(update={"scene": located(one.scene, folder)}) for one in self.recordings)
        names = [one.name for one in found]
        if twin := next((name for name in names if names.count(name) > 1), None):
            raise InputError("suite", "recordings", f"recordings with names that differ; two are called {twin!r}")
        return found


class PredictionTrack(StrictModel):
    """Define a track of world models, which predict images and poses of drives through scenes whose map they are given.

    ``seconds`` of processor time a model may use for a drive.
    """

    kind: Literal["prediction"]
    about: Text
    scenes: Annotated[tuple[Text, ...], Field(min_length=1)]
    drives: Annotated[int, Field(gt=0)]  # of each scene
    seed: Annotated[int, Field(ge=0)] = 0
    map: Text | None = None
    seconds: Seconds

    def located(self, folder: Path) -> tuple[str, ...]:
        """Return the scenes as they are loaded; raise :class:`InputError` for two of one name."""
        found = tuple(located(scene, folder) for scene in self.scenes)
        names = [scene_name(scene) for scene in found]
        if twin := next((name for name in names if names.count(name) > 1), None):
            raise InputError("suite", "scenes", f"scenes with names that differ; two are called {twin!r}")
        return found


Track: TypeAlias = Annotated[DrivingTrack | SlamTrack | PredictionTrack, Field(discriminator="kind")]


class Suite(StrictModel):
    """Hold the tracks of a suite by name; ``frozen``: hashes of their scenes, tasks and maps; ``hash``: of all."""

    name: Text
    tracks: Annotated[dict[str, Track], Field(min_length=1)]
    frozen: dict[str, str] = Field(default_factory=dict)
    hash: str = ""

    def content_hash(self) -> str:
        """Return the first 16 hex digits of the SHA-256 of all but ``hash``."""
        return content_hash(self, without="hash")

    def track_hash(self, name: str) -> str:
        """Return a hash of one track, its scenes, tasks and maps, which is the same in all suites that have it."""
        track = self.tracks[name]
        stated = {key: value for key, value in self.frozen.items() if key.partition(":")[0] == name}
        stated |= {key: self.frozen.get(key, "") for key in _given(track)}
        part = Suite(name=name, tracks={name: track}, frozen=stated)
        return part.content_hash()


def given_seed(seed: int) -> int:
    """Return the 32-bit seed that an entry is given: it is not the one that the truth was drawn with."""
    return int(np.random.SeedSequence([seed, 1]).generate_state(1)[0])


def _given(track: DrivingTrack | SlamTrack | PredictionTrack) -> list[str]:
    """Return the keys under which the scenes and the map of a track are frozen."""
    if isinstance(track, SlamTrack):
        scenes: list[str] = [one.scene for one in track.recordings]
    else:
        scenes = list(track.config().scenes if isinstance(track, DrivingTrack) else track.scenes)
    of_map = [] if isinstance(track, SlamTrack) or track.map is None else [f"map {track.map}"]
    return [*of_map, *(f"scene {scene_name(scene)}" for scene in scenes)]


def suite_file(name: str) -> Path:
    """Return the file of a suite: of a public one by its name, or of a size, or a file of yours.

    Raises:
        InputError: neither.
    """
    found = SUITES / f"{NEWEST.get(name, name)}.yaml"
    if found.is_file() and Path(name).name == name:
        return found
    if Path(name).is_file():
        return Path(name)
    known = [*NEWEST, *sorted(path.stem for path in SUITES.glob("*.yaml"))]
    raise InputError("benchmark", "suite", f"the file of a suite, or {one_of(known, name)}")


def read_suite(path: Path) -> Suite:
    """Read a suite's file; raise :class:`InputError` for one that has changed since it was frozen."""
    suite = read_yaml(path, Suite)
    for name, track in suite.tracks.items():
        if not name.isidentifier():
            raise InputError(path, "tracks", f"names that are words, for folders; found {name!r:.80}")
        if isinstance(track, DrivingTrack):
            track.config(folder=path.parent)
        else:
            track.located(path.parent)
    if suite.hash != suite.content_hash():
        expected = f"{suite.content_hash()}, the hash of the suite as it is; found {suite.hash!r:.80}"
        how = "freeze(Path(FILE)) of vssm_gym.eval.benchmark.suite writes it; one that has results needs another name"
        raise InputError(path, "hash", f"{expected}: {how}")
    return suite


def check_frozen(suite: Suite, path: Path, tracks: Iterable[str]) -> None:
    """Compute the scenes, tasks and maps of some tracks; raise :class:`InputError` where one is not the suite's."""
    for name, found in state(suite.tracks, path.parent, tracks).items():
        if suite.frozen.get(name) != found:
            expected = f"{suite.frozen.get(name)}, as it was frozen in {suite.name}; this version of the package has"
            raise InputError(path, f"frozen.{name}", f"{expected} {found}: its results would be of other tasks")


def state(suite: Mapping[str, Track], folder: Path, tracks: Iterable[str]) -> dict[str, str]:
    """Return the hashes of the rules, scenes, tasks and shipped maps of some tracks."""
    found: dict[str, str] = {}
    for name in tracks:
        track = suite[name]
        found[f"{name}: rules"] = _rules_of(track)
        if not isinstance(track, SlamTrack) and track.map is not None:
            found[f"map {track.map}"] = map_hash(shipped(track.map, MAPS))
        if isinstance(track, DrivingTrack):
            found |= _sweep_state(name, track.config(folder=folder))
        else:
            given = track.located(folder)
            scenes = [one if isinstance(one, str) else one.scene for one in given]
            found |= {f"scene {scene_name(scene)}": load_scene(scene).content_hash() for scene in scenes}
    return found


def _rules_of(track: DrivingTrack | SlamTrack | PredictionTrack) -> str:
    """Return the hash of the numbers behind a track."""
    return rules_hash(track.kind, track.config().env[0] if isinstance(track, DrivingTrack) else None)


def _sweep_state(name: str, config: SweepConfig) -> dict[str, str]:
    """Return the hashes of a sweep's scenes, and of the starts and goals of its tasks."""
    found, protocol = {}, protocol_of(config.env[0])
    with tempfile.TemporaryDirectory() as folder:
        for scene in config.scenes:
            apartment, short = protocol.load(scene), scene_name(scene)
            path = Path(folder) / f"{short}.json"
            protocol.write_tasks(apartment, max(config.tasks) + 1, path)
            tasks = read_json(path)["tasks"]
            places = [[_rounded(tasks[k]["start"]), _rounded(tasks[k]["goal"])] for k in config.tasks]
            digest = hashlib.sha256(json.dumps(places).encode()).hexdigest()
            found[f"scene {short}"] = apartment.content_hash()
            found[f"{name}: tasks of {short}"] = digest[:16]
    return found


def _rounded(place: Iterable[float]) -> list[float]:
    return [round(float(value), PLACE_DIGITS) for value in place]


def freeze(path: Path) -> Suite:
    """Write the hashes of a suite's tracks into its file, once it holds what it should; comments stay.

    Raises:
        InputError: a file that is no suite, or one that is frozen already.
    """
    suite = read_yaml(path, Suite)
    if suite.frozen or suite.hash:
        raise InputError(path, "hash", "a suite that is not frozen yet: take out frozen and hash, and change its name")
    suite = suite.model_copy(update={"frozen": state(suite.tracks, path.parent, suite.tracks)})
    suite = suite.model_copy(update={"hash": suite.content_hash()})
    stated = yaml.safe_dump({"frozen": suite.frozen, "hash": suite.hash}, sort_keys=False)
    with atomic_write(path) as temporary:
        temporary.write_text(path.read_text(encoding="utf-8").rstrip() + "\n" + stated, encoding="utf-8")
    return suite
