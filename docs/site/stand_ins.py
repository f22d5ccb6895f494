"""Stand in for libraries of extras that are not installed, so that modules which import them have a reference, too.

Nothing of such a library is run when a page is made: its names are base classes and annotations.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any

LIBRARIES = ("stable_baselines3", "torch")  # of the extra `rl`: what modules of the reference import at their top


class Named(type):
    """Make a class for every name that is read of one, such as ``nn.Module``."""

    def __getattr__(cls, name: str) -> Any:
        return named(cls, name, f"{cls.__module__}.{cls.__name__}")


class StandIn(ModuleType):
    """Make a class for every name that is read of the module."""

    def __getattr__(self, name: str) -> Any:
        return named(self, name, self.__name__)


class Finder:
    """Find modules of some libraries, and load stand-ins."""

    def __init__(self, libraries: Sequence[str]) -> None:
        self.libraries = libraries

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the specification of a module of one of the libraries."""
        return ModuleSpec(name, self, is_package=True) if name.partition(".")[0] in self.libraries else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Make a module."""
        return StandIn(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Define nothing: names are made as they are read."""


def named(owner: Any, name: str, module: str) -> type:
    """Return a new class that ``owner`` keeps under its name."""
    if name.startswith("__"):
        raise AttributeError(name)
    made = Named(name, (), {"__module__": module})
    setattr(owner, name, made)
    return made


def install() -> None:
    """Stand in for the libraries that are not installed."""
    sys.meta_path.append(Finder([name for name in LIBRARIES if find_spec(name) is None]))  # type: ignore[arg-type]
