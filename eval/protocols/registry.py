"""Define the episode protocol: the functions by which a sweep loads scenes, sets tasks and runs the episodes of one
environment.

A protocol is a module of this folder. :data:`vssm_gym.envs.registration.ENVIRONMENTS` says which environments have one,
and which robot and task it is for.
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
    from vssm_gym.eval.episodes.recorder import Wrap

SWEPT_ENVIRONMENTS = {name: spec for name, spec in ENVIRONMENTS.items() if spec.protocol}
"""The environments that sweeps run: those with an episode protocol, by id."""


class EpisodeProtocol(Protocol):
    """Define the functions that a sweep needs of an environment, implemented by the modules in :data:`ENVIRONMENTS`."""

    def scene_names(self) -> Sequence[str]:
        """Return the names of the built-in scenes; a sweep also accepts the path of a scene file."""
        ...

    def conditions(self) -> Mapping[str, Sequence[str]]:
        """Return the names that a condition may have: robot, noise, sensor noise, renderer, direction frame."""
        ...

    def load(self, scene: str) -> "Apartment":
        """Load the scene of a name or file; raise :class:`InputError` where no episode can run in it."""
        ...

    def notice(self, apartment: "Apartment") -> str:
        """Return what a reader of results should know about a scene, in one line; empty where there is nothing."""
        ...

    def write_tasks(self, apartment: "Apartment", n: int, path: Path) -> None:
        """Write the first ``n`` test tasks of a scene to a file; keep a file that already holds them."""
        ...

    def ensure_map(
        self, scene: str, folder: Path, *, voxel: float, seed: int, poses: Any, surfaces: Any, on_progress: Any = None
    ) -> Path:
        """Return the file of the learned map of a scene in a sweep's folder; make it if it is not there."""
        ...

    def load_map(self, path: Path) -> Any:
        """Return the learned map of a file, as :meth:`run` takes it."""
        ...

    def run(
        self, episode: "Episode", agent: "Agent", task_file: Path, learned: Any, *, wrap: "Wrap" = ...
    ) -> dict[str, Any]:
        """Run one episode in the environment that ``wrap`` returns, and return the measured fields of its row."""
        ...


def view_of(env: str) -> Any:
    """Return the :class:`vssm_gym.eval.report.view.View` that reports of ``env`` use."""
    module, _, name = str(SWEPT_ENVIRONMENTS[env].view).partition(":")
    return getattr(import_module(module), name)


def protocol_of(env: str) -> EpisodeProtocol:
    """Return the episode protocol of ``env``, one of :data:`SWEPT_ENVIRONMENTS`."""
    return cast(EpisodeProtocol, import_module(str(SWEPT_ENVIRONMENTS[env].protocol)))
