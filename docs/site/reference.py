"""Write the reference of the public names, and of the names that the programs of the pages import from modules."""

import ast
import importlib
import inspect
import re
from collections import defaultdict
from pathlib import Path
from types import ModuleType

import vssm_gym as vg
from vssm_gym.envs.registration import ENVIRONMENTS

DOCS = Path(__file__).resolve().parents[1]
BASE = "vssm_gym.envs.phased.PhasedEnv"  # whose methods have one entry for all environments
KEYWORDS = ("vssm_gym.envs.simulation.Simulation", "vssm_gym.envs.world_model.config.Imagination")
OWN = "   :exclude-members: passes_to, refuses, sense, report, panels, captions\n"


def reference(*names: str) -> str:
    """Return the entries of public names; the pages of ``docs/reference`` group them."""
    return "\n".join(entry(f"{vg.PUBLIC[name]}.{name}") for name in names)


def environment_classes() -> str:
    """Return the entries of the classes behind the registered ids."""
    paths = dict.fromkeys(spec.env.replace(":", ".") for spec in ENVIRONMENTS.values())
    return "\n".join(entry(path, OWN) for path in paths)


def environment_bases() -> str:
    """Return the entries of what these classes share: reset, step and render, and the keywords that they pass on."""
    return "\n".join([entry(BASE, signature="()"), *(entry(path, "   :no-members:\n") for path in KEYWORDS)])


def imported() -> str:
    """Return the entries of the names that programs of the pages import from modules, a heading for each module."""
    parts = []
    for module, names in sorted(imports().items()):
        parts += [f"## `{module}`\n", *(entry(home(f"{module}.{name}")) for name in sorted(names))]
    return "\n".join(parts)


def imports() -> dict[str, set[str]]:
    """Return ``module -> names`` of the imports in the Python blocks of ``docs``: those without an entry elsewhere."""
    known = {id(getattr(vg, name)) for name in vg.PUBLIC}
    known |= {id(target(spec.env.replace(":", "."))) for spec in ENVIRONMENTS.values()}
    known |= {id(target(path)) for path in (BASE, *KEYWORDS)}
    found: dict[str, set[str]] = defaultdict(set)
    for page in sorted(DOCS.rglob("*.md")):
        for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vssm_gym."):
                    for alias in node.names:
                        if (one := id(target(f"{node.module}.{alias.name}"))) not in known:
                            known.add(one)
                            found[str(node.module)].add(alias.name)
    return found


def home(path: str) -> str:
    """Return the dotted name of a class or function in the module that defines it."""
    found = target(path)
    defined = inspect.isclass(found) or inspect.isfunction(found)
    return f"{found.__module__}.{found.__qualname__}" if defined else path


def target(path: str) -> object:
    """Return the object of a dotted name."""
    module, _, name = path.rpartition(".")
    owner = importlib.import_module(module)
    return getattr(owner, name) if hasattr(owner, name) else importlib.import_module(path)


def entry(path: str, members: str = "   :members:\n", signature: str = "") -> str:
    """Return the directive that documents one name, with the signature that Python states unless one is given."""
    found = target(path)
    if isinstance(found, ModuleType):
        kind = "automodule"
    elif inspect.isclass(found):
        kind = "autoclass"
    elif callable(found):
        kind, members = "autofunction", ""
    else:
        return f"```{{eval-rst}}\n.. py:data:: {path}\n```\n"  # autodoc would show the docstring of its class
    return f"```{{eval-rst}}\n.. {kind}:: {path}{signature}\n{members}```\n"
