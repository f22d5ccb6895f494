"""Take agents that a program has registered into a sweep: worker processes import their classes from its files.

Rows are of one state of an agent's code: the manifest holds a hash of it, and rows of other code are not continued.
"""

import hashlib
import sys
from collections.abc import Iterable
from importlib.metadata import Distribution, distribution, packages_distributions
from pathlib import Path
from typing import TYPE_CHECKING

from vssm_gym.errors import InputError
from vssm_gym.files.bounded import read_bytes

if TYPE_CHECKING:  # the registry brings JAX along, and a worker must set up its threads before JAX starts
    from vssm_gym.agents.base import Agent

SOURCE_BYTES = 16 << 20  # of a Python file
GUARD = 'if __name__ == "__main__":'


def own_agents(names: Iterable[str]) -> dict[str, "type[Agent]"]:
    """Return the classes of those agents that are registered by a program, by name."""
    from vssm_gym.agents.registry import AGENTS, BUILT_IN, WITH

    bases = dict.fromkeys(name.partition(WITH)[0] for name in names)
    return {name: AGENTS[name] for name in bases if name in AGENTS and name not in BUILT_IN}


def code_hashes(agents: dict[str, "type[Agent]"]) -> dict[str, str]:
    """Return the :func:`code_hash` of each class that has one."""
    found = {name: code_hash(kind) for name, kind in agents.items()}
    return {name: code for name, code in found.items() if code is not None}


def code_hash(kind: type) -> str | None:
    """Return a hash of the code that a class is made of, 16 hex digits; None of a class without a file.

    Of a class of an installed distribution it covers the distribution's name, version and RECORD (the hashes of its
    files); of any other all Python files of its package, or those beside its file, with the packages there. Code
    elsewhere, other distributions and data files such as weights are not covered.
    """
    module = sys.modules.get(kind.__module__)
    file = getattr(module, "__file__", None)
    if file is None or not Path(file).is_file():
        return None
    digest = hashlib.sha256(kind.__qualname__.encode())
    top = kind.__module__.partition(".")[0]
    installed = _distribution_of(Path(file).resolve(), top)
    if installed is not None:
        digest.update(f"{installed.metadata['Name']} {installed.version}\n{installed.read_text('RECORD')}".encode())
    else:
        for path in _files_of(top, Path(file).resolve()):
            digest.update(path.name.encode() + b"\0" + read_bytes(path, SOURCE_BYTES))
    return digest.hexdigest()[:16]


def _distribution_of(file: Path, top: str) -> Distribution | None:
    """Return the installed distribution with a RECORD that holds a file; None of one that is edited in place."""
    for name in packages_distributions().get(top, []):
        found = distribution(name)
        if any(Path(str(one.locate())).resolve() == file for one in found.files or ()) and found.read_text("RECORD"):
            return found
    return None


def _files_of(top: str, file: Path) -> list[Path]:
    """Return the Python files of a package, or those beside a file, in packages there too, in order."""
    package = getattr(sys.modules.get(top), "__path__", None)
    if package is not None:
        return sorted(path for folder in package for path in Path(folder).rglob("*.py"))
    beside = [
        path.parent for path in file.parent.glob("*/__init__.py") if path.parent.name != __name__.partition(".")[0]
    ]
    return sorted({file, *file.parent.glob("*.py"), *(path for folder in beside for path in folder.rglob("*.py"))})


def check_importable(agents: dict[str, "type[Agent]"]) -> None:
    """Raise :class:`InputError` where worker processes could not import the program or a class of its agents."""
    main = sys.modules["__main__"]
    file = getattr(main, "__file__", None)
    if file is not None and getattr(main, "__spec__", None) is None and not Path(file).is_file():
        expected = f"a program in a file, which worker processes import; found {file}: save it and run the file"
        raise InputError("run_sweep", "program", expected)
    for name, kind in agents.items():
        if kind.__module__ == "__main__" and file is None:
            expected = "a class in a file, which worker processes import; found one of a notebook, prompt or python -c"
            raise InputError(f"agent {name}", "class", f"{expected}: write it into a .py file and import that")
        found: object = sys.modules.get(kind.__module__)
        for part in kind.__qualname__.split("."):
            found = getattr(found, part, None)
        if found is not kind:
            expected = f"a class at the top level of a file, which worker processes import; found {kind.__qualname__}"
            raise InputError(f"agent {name}", "class", expected)
