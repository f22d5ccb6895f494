"""State what is installed on a machine, as far as results depend on it, and refuse machines that differ."""

import hashlib
import importlib.metadata
import platform
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from vssm_gym.errors import InputError
from vssm_gym.version import __version__

ALSO = ("pybullet", "stable-baselines3", "torch")  # optional libraries that results depend on
CODE = "code of vssm_gym"


@cache
def installed() -> dict[str, str]:
    """Return names and versions: the package, a digest of its code, Python, and the libraries that it requires."""
    try:
        declared = importlib.metadata.requires("vssm-gym") or []
    except importlib.metadata.PackageNotFoundError:
        declared = []
    names = [re.split(r"[^A-Za-z0-9_.-]", text)[0] for text in declared if "extra ==" not in text]
    libraries = {name: _version(name) for name in (*names, *ALSO)}
    return {"vssm_gym": __version__, CODE: code_digest(), "Python": platform.python_version()} | libraries


def code_digest() -> str:
    """Return 16 hex digits of a hash of all modules of the package: a version's name says nothing of later changes."""
    package = Path(__file__).resolve().parents[1]
    found = hashlib.sha256()
    for folder in (package, package / "agents", package / "eval"):  # the last two may be links
        for path in sorted(folder.rglob("*.py")):
            found.update(f"{path.relative_to(folder)}\n".encode() + path.read_bytes())
    return found.hexdigest()[:16]


def check_same(here: Mapping[str, str], there: Mapping[str, str], machine: str) -> None:
    """Raise :class:`InputError` that names the first difference between this machine and another one."""
    for name, version in here.items():
        if there.get(name) != version:
            expected = f"{name} {version}, as on the machine of the command; found {there.get(name, 'none')}"
            raise InputError("--ray", f"machine {machine}", f"{expected}: install the same on all machines")


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
