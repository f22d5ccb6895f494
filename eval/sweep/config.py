"""Read and check a sweep's configuration, whose lists multiply into episodes, before anything runs."""

import itertools
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from vssm_gym.agents.base import ANY_TASK
from vssm_gym.agents.policy.policy_file import PREFIX as POLICY
from vssm_gym.agents.policy.policy_file import agent_label, policy_at
from vssm_gym.agents.renamed import refuse_former
from vssm_gym.envs.scenes.generator import PREFIX, parse_spec
from vssm_gym.envs.scenes.specs import scene_file, scene_name
from vssm_gym.errors import InputError, did_you_mean, one_of
from vssm_gym.eval.episodes.identity import Condition, Episode, ExploreSettings
from vssm_gym.eval.protocols.registry import SWEPT_ENVIRONMENTS, protocol_of
from vssm_gym.files.bounded import is_file
from vssm_gym.files.yaml_file import Names, Seeds, as_tuple, first_problem, printable, read_yaml

CONDITIONS = ("robot", "noise", "sensor_noise", "renderer", "physics", "direction_frame")
OF_ONE = {"scenes": "scene", "agents": "agent"}  # arguments of commands that take one of them
MOST_TASKS = 100_000  # of a scene
MOST_EPISODES = 1_000_000  # of a sweep; a thousand hours of them
_RANGE = re.compile(r"\s*([0-9]{1,9})\s*-\s*([0-9]{1,9})\s*")
DEFAULT_VOXEL = 0.05  # m: the truncation band of two cells is then no thicker than an inner wall of 10 cm


def _task_ids(value: Any) -> Any:
    """Parse ``100`` (the first hundred test tasks), ``"20-39"`` (these numbers, both included) or a list."""
    expected = "a number of tasks (at least 1), a range like 20-39 or a list of task numbers"
    if isinstance(value, bool):
        raise ValueError(expected)
    if isinstance(value, int):
        if value < 1:
            raise ValueError(f"{expected}, found {value}")
        value = f"0-{value - 1}"
    if not isinstance(value, str):
        return as_tuple(value)
    found = _RANGE.fullmatch(value)
    if not found:
        raise ValueError(f"{expected}, found {value!r:.100}")
    first, last = int(found[1]), int(found[2])
    if last - first >= MOST_TASKS:
        raise ValueError(f"at most {MOST_TASKS:,} tasks, found {value:.100}")
    return tuple(range(first, last + 1))


class SweepConfig(BaseModel):
    """Define a sweep: the product of all lists, over the chosen test tasks of each scene.

    ``scenes`` are built-in names, ``procedural:SEED`` or scene files (``houses.jsonl.gz#7``), ``agents`` are names of
    the registry, also with a planner (``astar+theta_star``), or ``policy:FILE``; a relative path starts at the folder
    of the YAML file.
    ``voxel`` (m) is the cell size of the agents' maps; ``map_poses`` sets whether these are learned at the recorded
    poses or at PRISM's estimates, ``map_surfaces`` whether they hold what was learned or the scene's surfaces, where
    those were seen, for budgets of errors. ``explore`` is for Explore alone. ``task_file`` holds tasks in place of the
    frozen ones, or episodes in Habitat's format; a relative path starts at the folder of the YAML file.
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
    direction_frame: Names = ("body",)
    tasks: Annotated[Seeds, BeforeValidator(_task_ids)]
    seeds: Seeds = (0,)
    voxel: Annotated[float, Field(gt=0.0, le=0.5)] = DEFAULT_VOXEL
    map_poses: Literal["recorded", "estimated"] = "recorded"
    map_surfaces: Literal["learned", "exact"] = "learned"
    explore: ExploreSettings | None = None
    task_file: Annotated[str, AfterValidator(printable)] | None = None


def expand(config: SweepConfig) -> Iterator[Episode]:
    """Yield every episode once: world by world, then task by task, so that a worker keeps its scene and map.

    Agents vary fastest: a sweep that is stopped early still has the same tasks for every agent.
    """
    lists = (getattr(config, name) for name in CONDITIONS)
    for scene, env, *condition_fields in itertools.product(config.scenes, config.env, *lists):
        condition = Condition(env, scene, *condition_fields)
        for task, seed, agent in itertools.product(config.tasks, config.seeds, config.agents):
            yield Episode(condition, task, seed, agent, config.explore)


def load_config(path: str | Path, scenes: Sequence[str] = (), agents: Sequence[str] = ()) -> SweepConfig:
    """Read and check the configuration of a sweep.

    Args:
        path: YAML file; relative scenes and policies in it start at its folder.
        scenes: take the place of those in the file, unless empty; relative ones start at the working folder.
        agents: likewise, with policies that start there.

    Returns:
        The configuration, every name of which is known.

    Raises:
        InputError: no such file, not YAML, a field that is unknown, missing or malformed, or an unknown name.
    """
    path = Path(path)
    config, folder, policies = read_yaml(path, SweepConfig), path.parent, path.parent
    if scenes:
        config, folder = _changed(config, scenes=tuple(scenes)), Path()
    if agents:
        config, policies = _changed(config, agents=tuple(agents)), Path()
    check_environments(config, path)
    if config.task_file is not None and SWEPT_ENVIRONMENTS[config.env[0]].robot != "holonomic":
        raise InputError(path, "task_file", f"none with {config.env[0]}: PointNav, ImageNav and Explore take one")
    lists = (getattr(config, name) for name in ("env", "scenes", "agents", *CONDITIONS, "tasks", "seeds"))
    if (episodes := math.prod(map(len, lists))) > MOST_EPISODES:
        raise InputError(path, "file", f"lists that multiply to at most {MOST_EPISODES:,} episodes; found {episodes:,}")
    protocol = protocol_of(config.env[0])
    found = tuple(
        scene if scene in protocol.scene_names() or scene.startswith(PREFIX) else str((folder / scene).resolve())
        for scene in config.scenes
    )
    named = tuple(policy_at(agent, policies) for agent in config.agents)
    task_file = None if config.task_file is None else str((path.parent / config.task_file).resolve())
    config = config.model_copy(update={"scenes": found, "agents": named, "task_file": task_file})
    check_names(config, path)
    return config


def _changed(config: SweepConfig, **change: tuple[str, ...]) -> SweepConfig:
    """Return the configuration with other values of a field."""
    changed = config.model_dump() | change
    try:
        return SweepConfig.model_validate(changed)
    except ValidationError as error:
        raise first_problem(Path("sweep"), error, SweepConfig, changed) from error


def check_environments(config: SweepConfig, source: object) -> None:
    """Raise :class:`InputError` unless the environments have protocols and share one robot and one task."""
    for env in config.env:
        if env not in SWEPT_ENVIRONMENTS:
            raise InputError(source, "env", one_of(SWEPT_ENVIRONMENTS, env))
    robots = tuple(dict.fromkeys(SWEPT_ENVIRONMENTS[env].robot for env in config.env))
    if len(robots) > 1:
        raise InputError(source, "env", f"environments of one robot; found {' and '.join(robots)}")
    if len({SWEPT_ENVIRONMENTS[env].task for env in config.env}) > 1:
        raise InputError(source, "env", f"environments of one task; found {' and '.join(config.env)}")
    if config.explore is not None and SWEPT_ENVIRONMENTS[config.env[0]].task != "explore":
        raise InputError(source, "explore", f"no such field with {config.env[0]}: only explorers have it")


def check_names(config: SweepConfig, source: object, arguments: Mapping[str, str] = MappingProxyType({})) -> None:
    """Raise :class:`InputError` with the available names for the first unknown name.

    Args:
        config: what is checked.
        source: file or command that the error names.
        arguments: names that a command has for fields.
    """
    # Imported here: the agents bring JAX along, and a worker must set up its threads before JAX starts.
    from vssm_gym.agents.registry import AGENTS, WITH, agent_type

    check_environments(config, source)

    def named(field: str) -> str:
        return arguments.get(field, field)

    for name in config.agents:
        refuse_former(name, source, named("agents"))
    spec, protocol = SWEPT_ENVIRONMENTS[config.env[0]], protocol_of(config.env[0])
    policies = [name for name in config.agents if name.startswith(POLICY)]
    planned = [name for name in config.agents if name.partition(WITH)[0] in AGENTS and name not in AGENTS]
    types = {name: agent_type(name) for name in (*AGENTS, *policies, *planned)}
    able = sorted(
        name for name, agent in types.items() if agent.robot == spec.robot and agent.task in (spec.task, ANY_TASK)
    )
    if len({agent_label(name) for name in config.agents}) < len(config.agents):
        raise InputError(source, named("agents"), "policies that differ from each other; two of these are the same")
    known: dict[str, Sequence[str]] = {
        "agents": able,
        **protocol.conditions(),
        "physics": spec.physics,
    }
    for field, available in known.items():
        for name in getattr(config, field):
            if name not in available:
                unfit = _unfit(name, env=config.env[0]) if field == "agents" else ""
                hint = "" if unfit.startswith(",") else did_you_mean(available, name)
                raise InputError(source, named(field), f"one of {', '.join(available)}; found {name!r}{hint}{unfit}")
    if "worn" in config.robot and "world" in config.direction_frame:
        expected = "body with the robot worn, whose drive follows commands in its own frame"
        raise InputError(source, named("direction_frame"), expected)
    if len({scene_name(scene) for scene in config.scenes}) < len(config.scenes):
        raise InputError(source, named("scenes"), "scenes whose file names differ: maps and rows are named after them")
    names = protocol.scene_names()
    for scene in config.scenes:
        if scene.startswith(PREFIX):
            parse_spec(scene)
        elif scene not in names and not is_file(scene_file(scene)):
            expected = f"a built-in scene ({', '.join(names)}), {PREFIX}SEED or an existing file; found {scene!r}"
            raise InputError(source, named("scenes"), f"{expected}{did_you_mean(names, scene)}")


def _unfit(name: str, env: str) -> str:
    """Return why an agent cannot take part in a sweep of an environment."""
    from vssm_gym.agents.registry import AGENTS, WITH

    spec, agent = SWEPT_ENVIRONMENTS[env], AGENTS.get(name.partition(WITH)[0])
    if agent is None:
        return " (an agent of your own is known to the program that registers it: run the sweep from there)"
    return f", whose robot is {agent.robot!r} and whose task is {agent.task!r}; {env} is {spec.robot!r}, {spec.task!r}"
