"""A sweep's configuration: lists multiply into episodes, and every name is checked before anything runs (DESIGN)."""

import hashlib
import itertools
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from vssm_gym.agents.policy_file import PREFIX as POLICY
from vssm_gym.agents.policy_file import agent_label, policy_at
from vssm_gym.envs.generator import PREFIX, parse_spec
from vssm_gym.errors import InputError

T = TypeVar("T")
DEFAULT_VOXEL = 0.05  # m: the truncation band of two cells is then no thicker than an inner wall of 10 cm


def as_tuple(value: Any) -> Any:
    """A list as a tuple, anything else as a tuple of it alone."""
    return tuple(value) if isinstance(value, (list, tuple)) else (value,)


def distinct(values: tuple[T, ...]) -> tuple[T, ...]:
    """The values; a repeated one raises ValueError."""
    if len(set(values)) != len(values):
        raise ValueError(f"values that differ from each other, found {list(values)}")
    return values


Names = Annotated[tuple[str, ...], BeforeValidator(as_tuple), AfterValidator(distinct), Field(min_length=1)]
Seeds = Annotated[
    tuple[Annotated[int, Field(ge=0)], ...], BeforeValidator(as_tuple), AfterValidator(distinct), Field(min_length=1)
]


def _task_ids(value: Any) -> Any:
    """``100`` is the first hundred test tasks, ``"20-39"`` those with these numbers (both included), a list itself."""
    if isinstance(value, bool):
        raise ValueError("a number of tasks, a range like 20-39 or a list of task numbers")
    if isinstance(value, int):
        return tuple(range(value))
    if isinstance(value, str):
        first, dash, last = value.partition("-")
        if not (dash and first.strip().isdigit() and last.strip().isdigit()):
            raise ValueError(f"a number of tasks, a range like 20-39 or a list of task numbers, found {value!r}")
        return tuple(range(int(first), int(last) + 1))
    return as_tuple(value)


class ExploreSettings(BaseModel):
    """How explorers run.

    ``steps`` (of 0.2 s) is the time limit of a run; ``navigation`` is how many PointNav tasks ``astar`` then drives on
    the map that the run left.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    steps: Annotated[int, Field(gt=0)] = 1500
    navigation: Annotated[int, Field(ge=0)] = 0


class SweepConfig(BaseModel):
    """What a sweep runs: the product of every list, over the chosen test tasks of each scene.

    ``scenes`` are built-in names or paths of scene files, ``agents`` are names of the registry or ``policy:FILE``; a
    relative path starts at the folder of the YAML file.
    ``voxel`` (m) is the cell size of the maps that agents are given; ``map_poses`` says whether their images were taken
    where the recording has them or where PRISM estimates them. ``explore`` is for Explore alone.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=False)

    env: Names = ("vssm_gym/PointNav-v0",)
    scenes: Names
    agents: Names
    robot: Names = ("holonomic",)
    noise: Names = ("low",)
    sensor_noise: Names = ("none",)
    renderer: Names = ("raycast",)
    physics: Names = ("mujoco",)
    tasks: Annotated[Seeds, BeforeValidator(_task_ids)]
    seeds: Seeds = (0,)
    voxel: Annotated[float, Field(gt=0.0, le=0.5)] = DEFAULT_VOXEL
    map_poses: Literal["recorded", "estimated"] = "recorded"
    explore: ExploreSettings | None = None


@dataclass(frozen=True)
class Condition:
    """What all episodes of one simulated world share."""

    env: str
    scene: str  # as the configuration names it
    robot: str
    noise: str
    sensor_noise: str
    renderer: str
    physics: str


@dataclass(frozen=True)
class Episode:
    """One run of one agent at one task of one world."""

    condition: Condition
    task: int
    seed: int  # of the sweep's list; `episode_seed` mixes it with scene and task
    agent: str
    explore: ExploreSettings | None = None  # of an explorer's run

    def identity(self, scene_hash: str) -> dict[str, Any]:
        """The fields of a row that say which episode it is, scenes by their short name and content."""
        c = self.condition
        return {
            "env": c.env,
            "scene": scene_name(c.scene),
            "scene_hash": scene_hash,
            "robot": c.robot,
            "noise": c.noise,
            "sensor_noise": c.sensor_noise,
            "renderer": c.renderer,
            "physics": c.physics,
            "task": self.task,
            "seed": self.seed,
            "agent": agent_label(self.agent),
        }


def scene_name(scene: str) -> str:
    """What rows and files call a scene: a built-in name as it is, a seed with dashes, a file by its stem."""
    return scene.replace(":", "-") if scene.startswith(PREFIX) else Path(scene).stem


def expand(config: SweepConfig) -> Iterator[Episode]:
    """Every episode once; world by world, then task by task, so that a worker keeps its scene and map.

    Agents vary fastest: a sweep that is stopped early still has the same tasks for every agent.
    """
    worlds = itertools.product(
        config.scenes, config.env, config.robot, config.noise, config.sensor_noise, config.renderer, config.physics
    )
    for scene, env, robot, noise, sensor_noise, renderer, physics in worlds:
        condition = Condition(env, scene, robot, noise, sensor_noise, renderer, physics)
        for task, seed, agent in itertools.product(config.tasks, config.seeds, config.agents):
            yield Episode(condition, task, seed, agent, config.explore)


def episode_seed(seed: int, scene_hash: str, task: int) -> int:
    """The seed of the environment's streams, uint32: of (seed, scene, task) and *not* of the agent.

    Agents so meet the same noise stream on the same task, which is what makes their difference a paired one.
    """
    text = json.dumps([seed, scene_hash, task])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "big")


def load_config(path: Path) -> SweepConfig:
    """Read and check a sweep's YAML.

    Raises:
        InputError: no such file, not YAML, a field that is unknown, missing or malformed, or a name nobody registered.
    """
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, "file", f"a readable YAML file ({error})") from error
    except yaml.YAMLError as error:
        raise InputError(path, "file", f"valid YAML ({' '.join(str(error).split())})") from error
    if not isinstance(data, dict):
        raise InputError(path, "file", f"fields {', '.join(SweepConfig.model_fields)}; found {type(data).__name__}")
    try:
        config = SweepConfig.model_validate(data)
    except ValidationError as error:
        raise first_problem(path, error, SweepConfig) from error
    scenes = tuple(_resolve(path, scene) for scene in config.scenes)
    agents = tuple(policy_at(agent, path.parent) for agent in config.agents)
    config = config.model_copy(update={"scenes": scenes, "agents": agents})
    check_names(config, path)
    return config


def first_problem(path: Path, error: ValidationError, model: type[BaseModel]) -> InputError:
    """What is wrong in a file of ``model``, its first problem only."""
    problem = error.errors()[0]
    field = ".".join(str(part) for part in problem["loc"]) or "file"
    if problem["type"] == "extra_forbidden":
        return InputError(path, field, f"one of the fields {', '.join(model.model_fields)}")
    if problem["type"] == "missing":
        return InputError(path, field, "this field")
    return InputError(path, field, problem["msg"].removeprefix("Value error, ").removeprefix("Input should be "))


def _resolve(config_path: Path, scene: str) -> str:
    """A built-in scene's name as it is; a file by its path, relative to the configuration that names it."""
    from vssm_gym.envs.scene import built_in_scenes

    known = scene in built_in_scenes() or scene.startswith(PREFIX)
    return scene if known else str((config_path.parent / scene).resolve())


def check_names(config: SweepConfig, source: object) -> None:
    """Raise :class:`InputError` with the available names for the first name that nothing answers to."""
    # Imported here: the agents bring JAX along, and a worker must set up its threads before JAX starts.
    from vssm_gym.agents.registry import AGENTS, agent_type
    from vssm_gym.envs.robots import NOISE_LEVELS
    from vssm_gym.envs.scene import built_in_scenes
    from vssm_gym.envs.sensor_noise import PRESETS
    from vssm_gym.envs.sensors import RENDERERS
    from vssm_gym.eval.courses import COURSES

    for env in config.env:
        if env not in COURSES:
            raise InputError(source, "env", f"one of {', '.join(COURSES)}; found {env!r}")
    robots = tuple(dict.fromkeys(COURSES[env].robot for env in config.env))
    if len(robots) > 1:
        raise InputError(source, "env", f"environments of one robot; found {' and '.join(robots)}")
    if len({COURSES[env].task for env in config.env}) > 1:
        raise InputError(source, "env", f"environments of one task; found {' and '.join(config.env)}")
    task = COURSES[config.env[0]].task
    if config.explore is not None and task != "explore":
        raise InputError(source, "explore", f"no such field with {config.env[0]}: only explorers have it")
    policies = [name for name in config.agents if name.startswith(POLICY)]
    types = {name: agent_type(name) for name in (*AGENTS, *policies)}
    able = sorted(name for name, agent in types.items() if (agent.robot, agent.task) == (robots[0], task))
    if len({agent_label(name) for name in config.agents}) < len(config.agents):
        raise InputError(source, "agents", "policies that differ from each other; two of these are the same")
    physics = list(COURSES[config.env[0]].physics)

    known: list[tuple[str, Sequence[str], Sequence[str]]] = [
        ("agents", config.agents, able),
        ("robot", config.robot, robots),
        ("noise", config.noise, list(NOISE_LEVELS)),
        ("sensor_noise", config.sensor_noise, list(PRESETS)),
        ("renderer", config.renderer, RENDERERS),
        ("physics", config.physics, physics),
    ]
    for field, chosen, available in known:
        for name in chosen:
            if name not in available:
                raise InputError(source, field, f"one of {', '.join(available)}; found {name!r}")
    if len({scene_name(scene) for scene in config.scenes}) < len(config.scenes):
        raise InputError(source, "scenes", "scenes whose file names differ: maps and rows are named after them")
    for scene in config.scenes:
        if scene.startswith(PREFIX):
            parse_spec(scene)
        elif scene not in built_in_scenes() and not Path(scene).is_file():
            raise InputError(
                source,
                "scenes",
                f"a built-in scene ({', '.join(built_in_scenes())}), {PREFIX}SEED or an existing file; found {scene!r}",
            )
