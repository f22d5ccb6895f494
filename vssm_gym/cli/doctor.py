"""Run ``vssm-gym doctor``: check what works on this machine, and say how to get what is missing."""

import importlib.metadata
import os
import platform
import re
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from vssm_gym.cli.shared.console import literal_console, say
from vssm_gym.compilation_cache import cache_folder
from vssm_gym.envs.rendering.gl_backends import BACKENDS, TIMEOUT, probe_code, try_python


@dataclass(frozen=True)
class Probe:
    """Define a program that runs in a process of its own, so that the crash of a driver ends nothing else."""

    name: str
    code: str  # prints what it found
    remedy: str  # how to get it
    required: bool = True


@dataclass(frozen=True)
class Finding:
    """Hold the result of one probe: a line of the table."""

    name: str
    ok: bool
    detail: str
    remedy: str
    required: bool
    partly: bool = False  # some of it is there

    @property
    def state(self) -> str:
        """Return the word of the table."""
        return "ok" if self.ok else "missing" if self.required else "partly" if self.partly else "absent"


JAX = """
import jax
print(", ".join(f"{d.platform}:{d.id} {d.device_kind}" for d in jax.devices()))
"""

NUMBA = """
import numba
assert numba.njit(lambda n: n + 1)(1) == 2
print("compiles;", numba.config.NUMBA_NUM_THREADS, "threads")
"""

# A ray from the origin along x meets a triangle at x = 2.
EMBREE = """
import numpy as np
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
scene = rtcore_scene.EmbreeScene()
TriangleMesh(scene, np.array([[[2, -1, -1], [2, 1, -1], [2, 0, 1]]], np.float32))
origin, along_x = np.zeros((1, 3), np.float32), np.array([[1, 0, 0]], np.float32)
assert abs(scene.run(origin, along_x, query="DISTANCE")[0] - 2) < 1e-5
print("traces rays")
"""

# A ball above a floor falls.
PHYSICS = """
import mujoco
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><geom type="plane" size="1 1 1"/>'
    '<body pos="0 0 1"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>'
)
data = mujoco.MjData(model)
for _ in range(10):
    mujoco.mj_step(model, data)
assert data.qpos[2] < 1
print("simulates")
"""

EXTRAS = {  # of pyproject.toml, and what they are for
    "rl": "train policies",
    "bullet": "the PyBullet simulator",
    "dynamics": "flights of the Blackbird data set",
    "datasets": "data sets of Minari and LeRobot",
    "cluster": "sweeps and trainings on a Ray cluster",
    "docs": "make docs",
    "human": "windows",
    "viz": "live viewer, videos",
    "dev": "tests and checks",
}
PROBES = (
    Probe("JAX", JAX, "pip install --force-reinstall jax jaxlib"),
    Probe("numba", NUMBA, "pip install --force-reinstall numba llvmlite"),
    Probe(
        "Embree (laser scans, coverage)",
        EMBREE,
        "pip install embreex, where it has a wheel; without it MuJoCo traces the rays, several times slower",
        required=False,
    ),
    Probe("MuJoCo (physics)", PHYSICS, "pip install --force-reinstall mujoco"),
    *(Probe(backend.title, probe_code(backend), backend.remedy, required=False) for backend in BACKENDS),
)


def doctor() -> int:
    """Check what works on this machine, and say how to get what is missing; exit with 1 if a requirement is."""
    from rich.progress import track
    from rich.table import Table
    from rich.text import Text

    findings = [_python(), _cores(), _packages(), *map(extra, EXTRAS), _cache()]
    with ThreadPoolExecutor(max_workers=2) as pool:
        console = literal_console(stderr=True)
        probed = track(pool.map(run_probe, PROBES), "probing", len(PROBES), console=console, transient=True)
        findings += probed

    table = Table(show_header=False, box=None, pad_edge=False)
    for finding in findings:
        colour = {"ok": "green", "missing": "red"}.get(finding.state, "yellow")
        table.add_row(Text(finding.state, style=colour), finding.name, finding.detail)
        if not finding.ok:
            table.add_row("", "", f"-> {finding.remedy}")
    literal_console().print(table)
    say("", "OpenGL is optional: the raycast camera, the default, does not use it.")
    return int(any(finding.required and not finding.ok for finding in findings))


def run_probe(probe: Probe) -> Finding:
    """Run one probe in a process of its own; a failure is stated in our words, never as the text of an exception."""
    ok, detail = try_python(probe.code, TIMEOUT)
    return Finding(probe.name, ok, detail if ok else _reason(detail), probe.remedy, probe.required)


def _reason(detail: str) -> str:
    """Say why a probe failed, from the last line that it wrote."""
    if detail.startswith("no answer in"):
        return detail
    return "is not installed" if detail.startswith("ModuleNotFoundError:") else "does not work here"


def _python() -> Finding:
    ok = (3, 11) <= sys.version_info < (3, 15)
    return Finding("Python", ok, f"{platform.python_version()} on {platform.platform()}", "Python 3.11-3.14", True)


def _cores() -> Finding:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return Finding("cores", True, f"{usable} usable", "", True)


def _packages() -> Finding:
    """Return the versions of the dependencies that the installed distribution declares."""
    versions, absent = _installed("")
    detail = "not installed as a distribution" if not versions else ", ".join(versions)
    if not versions:
        return Finding("packages", False, detail, "pip install -e . in the checkout", True)
    detail += f"; not installed: {', '.join(absent)}" if absent else ""
    return Finding("packages", not absent, detail, f"pip install {' '.join(absent)}", True)


def extra(name: str) -> Finding:
    """Return the versions of the packages of an extra, which is optional."""
    versions, absent = _installed(name)
    detail = f"{', '.join(versions)}; " * bool(versions) + f"not installed: {', '.join(absent)}" * bool(absent)
    title = f"extra {name} ({EXTRAS[name]})"
    return Finding(
        title,
        not absent,
        detail.removesuffix("; "),
        f"pip install -c constraints.txt {' '.join(absent)} in the checkout",
        False,
        partly=bool(versions),
    )


def requirements(extra: str = "") -> list[str]:
    """Return the requirements that the installed distribution declares, or those of an extra; none without it."""
    try:
        declared = importlib.metadata.requires("vssm-gym") or []
    except importlib.metadata.PackageNotFoundError:
        return []
    found = [re.search(r"""extra == ["']([^"']+)["']""", text) for text in declared]
    return [text for text, marker in zip(declared, found, strict=True) if (marker[1] if marker else "") == extra]


def _installed(extra: str) -> tuple[list[str], list[str]]:
    """Return names with versions of the requirements that are installed, and the names of the others."""
    versions, absent = [], []
    for requirement in requirements(extra):
        name = re.split(r"[^A-Za-z0-9_.-]", requirement)[0]
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            if extra or ";" not in requirement:  # one with another marker is for some platforms, and has its own probe
                absent.append(name)
    return versions, absent


def _cache() -> Finding:
    """Check the compilation cache: without a writable one, every start compiles for about a minute."""
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        remedy = "set XDG_CACHE_HOME to a folder that can be written"
        return Finding("cache", False, f"{folder} cannot be written", remedy, False)
    return Finding("cache", True, f"{folder} is writable", "", False)
