"""Register the environments with Gymnasium from one table, which sweeps, reports and tests read too.

A row names modules by strings, because importing ``vssm_gym`` must load none of them, and because environments may not
import the evaluation that runs in them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class EnvironmentSpec:
    """Describe one environment: its classes, what agents drive in it, and how sweeps and reports treat it.

    Attributes:
        id: the name that ``gym.make`` takes.
        env: ``module:class`` of one environment.
        vector: ``module:factory`` of many environments at once.
        max_episode_steps: steps after which an episode is truncated (``gym.make(..., max_episode_steps=N)`` overrides
            it); None where the environment ends each episode by itself.
        keywords: keywords of the constructor that differ from its defaults.
        robot: the robot that an agent must be made for (:mod:`vssm_gym.agents.base`).
        task: the task that an agent must be made for.
        physics: simulators that a sweep may choose from.
        protocol: module that sets the tasks of a sweep's episodes, runs and evaluates them
            (:class:`vssm_gym.eval.protocols.registry.EpisodeProtocol`); None where no sweep runs.
        view: ``module:name`` of the layout of its report (:class:`vssm_gym.eval.report.view.View`); None where no sweep
            runs.
    """

    id: str
    env: str
    vector: str
    max_episode_steps: int | None
    keywords: Mapping[str, Any] = field(default_factory=dict)
    robot: str = ""
    task: str = ""
    physics: tuple[str, ...] = ()
    protocol: str | None = None
    view: str | None = None


# PointNav as most policies want it: a goal seen from the robot, small images of bytes, actions in [-1, 1].
_POLICY = {
    "camera": {"width": 64, "height": 48},
    "images": ("depth_image",),
    "sensors": ("gps_compass",),
    "goal": "sensed",
    "actions": "normalized",
    "end_on": "reach",
}

_ROWS = (
    EnvironmentSpec(
        id="vssm_gym/PointNav-v0",
        env="vssm_gym.envs.pointnav:PointNavEnv",
        vector="vssm_gym.envs.vector:pointnav",
        max_episode_steps=500,  # 80 m at full speed
        robot="holonomic",
        task="pointgoal",
        physics=("mujoco",),
        protocol="vssm_gym.eval.protocols.pointnav",
        view="vssm_gym.eval.report.view:POINTNAV_VIEW",
    ),
    EnvironmentSpec(
        id="vssm_gym/PointNavGPS-v0",
        env="vssm_gym.envs.pointnav:PointNavEnv",
        vector="vssm_gym.envs.vector:pointnav",
        max_episode_steps=500,
        keywords=_POLICY,
    ),
    EnvironmentSpec(
        id="vssm_gym/PointNavDiscrete-v0",
        env="vssm_gym.envs.pointnav:PointNavEnv",
        vector="vssm_gym.envs.vector:pointnav",
        max_episode_steps=500,
        keywords=_POLICY | {"actions": "discrete"},
    ),
    EnvironmentSpec(
        id="vssm_gym/ImageNav-v0",
        env="vssm_gym.envs.imagenav:ImageNavEnv",
        vector="vssm_gym.envs.vector:imagenav",
        max_episode_steps=500,
        robot="holonomic",
        task="imagegoal",
        physics=("mujoco",),
        protocol="vssm_gym.eval.protocols.pointnav",  # PointNav's tasks; the goal is an image
        view="vssm_gym.eval.report.view:POINTNAV_VIEW",
    ),
    EnvironmentSpec(
        id="vssm_gym/Explore-v0",
        env="vssm_gym.envs.explore:ExploreEnv",
        vector="vssm_gym.envs.vector:explore",
        max_episode_steps=2000,  # 320 m at full speed
        robot="holonomic",
        task="explore",
        physics=("mujoco",),
        protocol="vssm_gym.eval.protocols.explore",
        view="vssm_gym.eval.report.explore:EXPLORE_VIEW",
    ),
    EnvironmentSpec(
        id="vssm_gym/LidarMaze-v0",
        env="vssm_gym.envs.lidar_maze:LidarMazeEnv",
        vector="vssm_gym.envs.vector:lidar_maze",
        max_episode_steps=1000,  # 20 m at full speed; the longest shortest path is 4 m
        robot="disc",
        task="pointgoal",
        physics=("none",),
        protocol="vssm_gym.eval.protocols.lidar_maze",
        view="vssm_gym.eval.report.lidar_maze:LIDAR_MAZE_VIEW",
    ),
    EnvironmentSpec(
        id="vssm_gym/Flight-v0",
        env="vssm_gym.envs.flight:FlightEnv",
        vector="vssm_gym.envs.vector:flight",
        max_episode_steps=None,  # with its reference, after 600 s at most
    ),
    EnvironmentSpec(
        id="vssm_gym/CarNav-v0",
        env="vssm_gym.envs.carnav:CarNavEnv",
        vector="vssm_gym.envs.vector:carnav",
        max_episode_steps=600,  # 60 s
        robot="car",
        task="pointgoal",
        physics=("mujoco", "bullet"),
        protocol="vssm_gym.eval.protocols.carnav",
        view="vssm_gym.eval.report.car:CAR_VIEW",
    ),
    EnvironmentSpec(
        id="vssm_gym/CarNav-v1",
        env="vssm_gym.envs.carnav:CarNavEnv",
        vector="vssm_gym.envs.vector:carnav",
        max_episode_steps=600,
        keywords={"end_on": "stop"},
        robot="car",
        task="pointgoal",
        physics=("mujoco", "bullet"),
        protocol="vssm_gym.eval.protocols.carnav",
        view="vssm_gym.eval.report.car:CAR_VIEW",
    ),
    # Imagined: it takes a map instead of a scene, and its vector environment is one compiled step.
    EnvironmentSpec(
        id="vssm_gym/WorldModelNav-v0",
        env="vssm_gym.envs.world_model.single:WorldModelNavEnv",
        vector="vssm_gym.envs.world_model.vector:WorldModelVectorEnv",
        max_episode_steps=500,
    ),
)
ENVIRONMENTS: dict[str, EnvironmentSpec] = {spec.id: spec for spec in _ROWS}


def register() -> None:
    """Register the environments; calling it twice changes nothing."""
    import gymnasium as gym  # loads NumPy, which reads its variables then (vssm_gym.instruction_set)

    for spec in ENVIRONMENTS.values():
        if spec.id not in gym.registry:
            gym.register(
                id=spec.id,
                entry_point=spec.env,
                vector_entry_point=spec.vector,
                max_episode_steps=spec.max_episode_steps,
                kwargs=dict(spec.keywords),
            )
