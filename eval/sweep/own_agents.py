"""Take agents that a program has registered into a sweep: worker processes import their classes from its files.

Rows are of one state of an agent's code: the manifest holds a hash of it, and rows of other code are not continued.
"""

import hashlib
import inspect
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from vssm_gym.errors import InputError

if TYPE_CHECKING:  # the registry brings JAX along, and a worker must set up its threads before JAX starts
    from vssm_gym.agents.base import Agent

GUARD = 'if __name__ == "__main__":'


def own_agents(names: Iterable[str]) -> dict[str, "type[Agent]"]:
    """Return the classes of those agents that are registered by a program, by name."""
    from vssm_gym.agents.registry import AGENTS, BUILT_IN, WITH

    bases = dict.fromkeys(name.partition(WITH)[0] for name in names)
    return {name: AGENTS[name] for name in bases if name in AGENTS and name not in BUILT_IN}


def code_hashes(agents: dict[str, "type[Agent]"]) -> dict[str, str]:
    """Return a hash of the source of each class, 16 hex digits; a class without a readable source has none.

    What a class inherits or calls is not part of it.
    """
    found = {}
    for name, kind in agents.items():
        try:
            found[name] = hashlib.sha256(inspect.getsource(kind).encode()).hexdigest()[:16]
        except (OSError, TypeError):
            continue
    return found


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
