"""The environments of sweeps: which robot does what there, and the module that sets, runs and judges their episodes."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

if TYPE_CHECKING:  # a worker is up before it pays for JAX and MuJoCo
    from vssm_gym.agents.base import Agent
    from vssm_gym.envs.scene import Apartment
    from vssm_gym.eval.config import Episode
    from vssm_gym.voxel_map import VoxelMap


class Entry(NamedTuple):
    """A row of :data:`COURSES`: agents of this robot and this task can run there (:mod:`vssm_gym.agents.base`)."""

    module: str
    robot: str
    task: str
    physics: tuple[str, ...]


COURSES = {
    "vssm_gym/PointNav-v0": Entry("vssm_gym.eval.pointnav_course", "holonomic", "pointgoal", ("mujoco",)),
    "vssm_gym/Explore-v0": Entry("vssm_gym.eval.explore_course", "holonomic", "explore", ("mujoco",)),
    "vssm_gym/CarNav-v0": Entry("vssm_gym.eval.carnav_course", "car", "pointgoal", ("mujoco", "bullet")),
}


class Course(Protocol):
    """What each of these modules offers."""

    def write_tasks(self, apartment: "Apartment", n: int, path: Path) -> None:
        """The first ``n`` test tasks of a scene as a file; one that is there and holds them is kept."""
        ...

    def run(self, episode: "Episode", agent: "Agent", task_file: Path, voxel_map: "VoxelMap | None") -> dict[str, Any]:
        """Run one episode; returns what it was worth, as fields of a row."""
        ...


def course_of(env: str) -> Course:
    """The module of an environment of :data:`COURSES`."""
    return import_module(COURSES[env].module)
