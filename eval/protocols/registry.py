"""The courses of sweeps: how the episodes of an environment are set, run and judged.

Which environments have one, and which robot and task it is for, is in :data:`vssm_gym.envs.registration.ENVIRONMENTS`.
"""

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from vssm_gym.envs.registration import ENVIRONMENTS

if TYPE_CHECKING:  # a worker is up before it pays for JAX and MuJoCo
    from vssm_gym.agents.base import Agent
    from vssm_gym.envs.scenes.scene import Apartment
    from vssm_gym.eval.episodes.identity import Episode
    from vssm_gym.maps.voxel_map import VoxelMap

COURSES = {name: spec for name, spec in ENVIRONMENTS.items() if spec.course}
"""The environments that sweeps know."""


class Course(Protocol):
    """The protocol of an environment's episodes; the modules that :data:`ENVIRONMENTS` names implement it."""

    def scene_names(self) -> Sequence[str]:
        """Names of the built-in scenes; any scene file is one, too."""
        ...

    def conditions(self) -> Mapping[str, Sequence[str]]:
        """The names that ``noise``, ``sensor_noise`` and ``renderer`` may take."""
        ...

    def load(self, scene: str) -> "Apartment":
        """The scene of a name or file; raises :class:`InputError` where no episode can run in it."""
        ...

    def notice(self, apartment: "Apartment") -> str:
        """What a reader of results should know about a scene, in one line; empty where there is nothing."""
        ...

    def write_tasks(self, apartment: "Apartment", n: int, path: Path) -> None:
        """Write the first ``n`` test tasks of a scene to a file; one that is there and holds them is kept."""
        ...

    def run(self, episode: "Episode", agent: "Agent", task_file: Path, voxel_map: "VoxelMap | None") -> dict[str, Any]:
        """Run one episode; returns its measured fields of a row."""
        ...


def view_of(env: str) -> Any:
    """What the report of an environment of :data:`COURSES` shows: a :class:`vssm_gym.eval.report.view.View`."""
    module, _, name = str(COURSES[env].view).partition(":")
    return getattr(import_module(module), name)


def course_of(env: str) -> Course:
    """The course of an environment of :data:`COURSES`."""
    return cast(Course, import_module(str(COURSES[env].course)))
