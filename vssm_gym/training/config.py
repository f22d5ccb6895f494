"""Read and check a training's configuration: environment, policy, algorithm and duration."""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from vssm_gym.errors import InputError
from vssm_gym.files.shipped import MAPS, beside, shipped
from vssm_gym.files.yaml_file import as_tuple, distinct, read_yaml
from vssm_gym.model.transition.learned_file import transition_hash

WORLD_MODEL, SIMULATOR, SENSED = "vssm_gym/WorldModelNav-v0", "vssm_gym/PointNav-v0", "vssm_gym/PointNavGPS-v0"
# Keywords that training sets itself
FIXED = (
    "actions",
    "camera",
    "end_on",
    "goal",
    "images",
    "max_depth",
    "observation",
    "observe_pose",
    "render_mode",
    "robot",
    "show_uncertainty",
    "tasks",
)

# Algorithms that train in the world model only, and why
IN_THE_MAP = {"bc": "the expert plans in its map", "ppo_jax": "its robots are part of the compiled program"}

TrainedId = Literal["vssm_gym/WorldModelNav-v0", "vssm_gym/PointNav-v0", "vssm_gym/PointNavGPS-v0"]
Whole = Annotated[int, Field(ge=1)]
Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
Widths = Annotated[tuple[Annotated[int, Field(ge=1, le=4096)], ...], BeforeValidator(as_tuple), Field(max_length=8)]
Inputs = Annotated[
    tuple[Literal["scan", "goal", "pose", "pose_std", "commands"], ...],
    BeforeValidator(as_tuple),
    AfterValidator(distinct),
    Field(min_length=1),
]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class EnvironmentSettings(BaseModel):
    """Define where a policy learns: an environment's id, its map or scene, and any of its other keywords.

    Relative paths start at the folder of the YAML file.
    """

    model_config = ConfigDict(frozen=True, extra="allow", allow_inf_nan=False)

    id: TrainedId = "vssm_gym/WorldModelNav-v0"
    map: str | None = None  # of WorldModelNav
    transition: str | None = None  # of WorldModelNav: a learned one
    scene: str | None = None  # of the others
    num_envs: Whole = 256
    max_episode_steps: Whole = 300
    contact_cost: Annotated[float, Field(ge=0.0)] = 0.0  # of a step in contact, on top of the environment's reward

    @property
    def keywords(self) -> dict[str, Any]:
        """Return the keywords of the environment's constructor that are not fields of this class."""
        return dict(self.model_extra or {})

    @model_validator(mode="after")
    def _one_source(self) -> "EnvironmentSettings":
        wanted, other = ("map", "scene") if self.id == WORLD_MODEL else ("scene", "map")
        if getattr(self, other) is not None:
            raise ValueError(f"no {other!r}: {self.id} takes a {wanted}")
        if self.transition is not None and self.id != WORLD_MODEL:
            raise ValueError(f"no 'transition': {self.id} moves its own robot")
        if self.transition is not None and "noise" in self.keywords:
            raise ValueError("no 'noise' beside 'transition': a learned transition has its own")
        if taken := sorted(set(self.keywords) & set(FIXED)):
            raise ValueError(f"no {taken[0]!r}: training sets it")
        return self


class PolicySettings(_Strict):
    """Define the inputs and the network of a policy; see :mod:`vssm_gym.agents.policy.features`."""

    inputs: Inputs = ("scan", "goal", "pose")
    frames: Annotated[int, Field(ge=1, le=64)] = 1
    hidden: Widths = (128, 128)
    activation: Literal["tanh", "relu"] = "tanh"

    @model_validator(mode="after")
    def _goal_seen(self) -> "PolicySettings":
        if "goal" not in self.inputs:
            raise ValueError("'goal' among the inputs: no policy finds an unknown goal")
        return self


class PPOSettings(_Strict):
    """Set up proximal policy optimisation (Schulman et al., 2017): ``ppo`` of stable-baselines3, or ``ppo_jax``.

    The second is a compiled program of robots, policy and updates; it trains in the world model only.
    """

    name: Literal["ppo", "ppo_jax"]
    learning_rate: Positive = 5e-4
    n_steps: Whole = 64
    batch_size: Whole = 4096
    n_epochs: Whole = 6
    gamma: Fraction = 0.99
    gae_lambda: Fraction = 0.95
    clip_range: Positive = 0.2
    ent_coef: Annotated[float, Field(ge=0.0)] = 0.002
    vf_coef: Positive = 0.5
    max_grad_norm: Positive = 0.5
    log_std_init: float = -0.5


class SACSettings(_Strict):
    """Set up soft actor-critic (Haarnoja et al., 2018) of stable-baselines3."""

    name: Literal["sac"]
    learning_rate: Positive = 3e-4
    buffer_size: Whole = 400_000
    learning_starts: Whole = 10_000
    batch_size: Whole = 1024
    gamma: Fraction = 0.99
    tau: Fraction = 0.005
    train_freq: Whole = 1
    gradient_steps: Whole = 2


class BCSettings(_Strict):
    """Set up behaviour cloning of A*: ``min sum |policy(x) - a|^2`` over demonstrations (Pomerleau, 1989)."""

    name: Literal["bc"]
    learning_rate: Positive = 1e-3
    batch_size: Whole = 1024
    epochs: Whole = 60


class TrainingConfig(_Strict):
    """Define a training: it ends after ``steps`` of all robots together or after ``minutes``, whichever is first."""

    name: Annotated[str, Field(min_length=1, max_length=40, pattern=r"^[\w.-]+$")]
    environment: EnvironmentSettings
    policy: PolicySettings = PolicySettings()
    algorithm: Annotated[PPOSettings | SACSettings | BCSettings, Field(discriminator="name")]
    steps: Whole
    minutes: Positive | None = None
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _whole_batches(self) -> "TrainingConfig":
        algorithm = self.algorithm
        if algorithm.name == "ppo_jax":
            taken = self.environment.num_envs * algorithm.n_steps
            if taken % min(algorithm.batch_size, taken):
                raise ValueError(f"a batch_size that divides num_envs x n_steps, {taken}; found {algorithm.batch_size}")
        return self


def load_training(path: Path, *, map_file: Path | None = None, seed: int | None = None) -> TrainingConfig:
    """Read and check a training's YAML; ``map_file`` and ``seed`` replace its own.

    Raises:
        InputError: no such file, not YAML, or a field that is unknown, missing or malformed.
    """
    config = read_yaml(path, TrainingConfig)
    where = config.environment
    if map_file is not None and where.id != WORLD_MODEL:
        raise InputError(path, "map", f"no --map: {where.id} has a scene")
    if map_file is None and where.map is not None:
        map_file = beside(where.map, path.parent, MAPS)
    if where.id != WORLD_MODEL and (why := IN_THE_MAP.get(config.algorithm.name)):
        raise InputError(path, "environment.id", f"{WORLD_MODEL}: {why}")
    if where.id == WORLD_MODEL and map_file is None:
        raise InputError(path, "environment.map", "a map file, here or as --map; `vssm-gym map build` makes one")
    if where.id != WORLD_MODEL and where.scene is None:
        raise InputError(path, "environment.scene", "a scene")
    if where.id == SENSED and (unseen := sorted(set(config.policy.inputs) - {"scan", "goal", "commands"})):
        raise InputError(path, "policy.inputs", f"scan, goal and commands; {SENSED} does not observe {unseen[0]!r}")
    if map_file is not None:
        where = where.model_copy(update={"map": str(shipped(map_file, MAPS).resolve())})
    if where.transition is not None:
        learned = (path.parent / where.transition).resolve()
        if not learned.is_file():
            raise InputError(path, "environment.transition", f"a file of vssm-gym train-dynamics; found {learned}")
        where = where.model_copy(update={"transition": str(learned)})
    changes: dict[str, Any] = {"environment": where} | ({} if seed is None else {"seed": seed})
    return config.model_copy(update=changes)


def training_hash(config: TrainingConfig, world_hash: str) -> str:
    """Hash what determines a training (configuration, content of map or scene); return 16 hex digits."""
    content = config.model_dump(mode="json")
    content["environment"] |= {"map": world_hash, "scene": None}
    transition = content["environment"].pop("transition")
    if transition is not None:
        content["environment"]["transition"] = transition_hash(transition)
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
