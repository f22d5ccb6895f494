"""Find an OpenGL backend that works on this machine: each is tried in a process of its own, where a crash is harmless.

MuJoCo's renderer draws in a context of EGL (a graphics card or Mesa, no screen), OSMesa (software) or GLFW (a screen).
``MUJOCO_GL`` is the user's: where it is set, only that backend is tried; it is never set here.
"""

import os
import subprocess
import sys
from dataclasses import dataclass
from functools import cache

from vssm_gym.errors import InputError

TIMEOUT = 120.0  # seconds for one try; a first import from a cold disk is slow


@dataclass(frozen=True)
class Backend:
    """Describe one kind of OpenGL context: MuJoCo's name for it, a title, and how to install it."""

    name: str
    title: str
    remedy: str


BACKENDS = (
    Backend(
        "egl",
        "OpenGL, EGL",
        "a graphics driver, or in software on Debian/Ubuntu: apt-get install libegl1 libgl1 libopengl0 libgl1-mesa-dri",
    ),
    Backend("osmesa", "OpenGL, OSMesa", "Debian/Ubuntu: apt-get install libosmesa6 libgl1 libopengl0"),
    Backend("glfw", "OpenGL, window", "a screen (X11 or Wayland)"),
)

# The context is made directly: a wrong value of MUJOCO_GL breaks `import mujoco` itself.
_PROBE = """
import warnings
warnings.simplefilter("ignore")
import mujoco, numpy as np
from mujoco.{backend} import GLContext
context = GLContext(64, 64)
context.make_current()
model = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><light pos="0 0 3"/><geom type="plane" size="1 1 1"/></worldbody></mujoco>'
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
scene, view = mujoco.MjvScene(model, 8), mujoco.MjrRect(0, 0, 64, 64)
mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, scene)
renderer = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
mujoco.mjr_render(view, scene, renderer)
image = np.zeros((64, 64, 3), np.uint8)
mujoco.mjr_readPixels(image, None, view, renderer)
assert image.std() > 0, "an empty picture"
from OpenGL import GL
name = GL.glGetString(GL.GL_RENDERER).decode()
renderer.free()
context.free()
print("draws with", name)
"""


def probe_code(backend: Backend) -> str:
    """Return a Python program that draws a picture, prints the renderer's name, and fails where that is impossible."""
    return _PROBE.format(backend=backend.name)


def try_python(code: str, timeout: float = TIMEOUT) -> tuple[bool, str]:
    """Run a program in a process of its own; return True if it succeeded, and the last line of its output."""
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, timeout=timeout, check=False
        )
    except subprocess.TimeoutExpired:
        return False, f"no answer in {timeout:.0f} s"
    ok = done.returncode == 0
    lines = (done.stdout if ok else done.stderr).strip().splitlines()
    return ok, lines[-1] if lines else f"ended with code {done.returncode}"


def find_backend() -> str:
    """Return the first backend that draws here, or the one in ``MUJOCO_GL`` if the user set it.

    Raises :class:`InputError` where none does, with each reason and remedy, as ``vssm-gym doctor`` prints them.
    """
    return _find(os.environ.get("MUJOCO_GL", "").lower())


@cache  # a try starts a process: a second or so
def _find(wanted: str) -> str:
    candidates = [backend for backend in BACKENDS if wanted in ("", backend.name)]
    if not candidates:
        names = ", ".join(backend.name for backend in BACKENDS)
        raise InputError("renderer", "MUJOCO_GL", f"unset, or one of {names}; found {wanted!r}")
    failures = []
    for backend in candidates:
        ok, detail = try_python(probe_code(backend))
        if ok:
            return backend.name
        failures.append(f"{backend.title}: {detail} -> {backend.remedy}")
    only = f"; MUJOCO_GL={wanted} allows no other backend" if wanted else ""
    expected = f"OpenGL, which no backend of this machine offers (see vssm-gym doctor{only})"
    raise InputError("renderer", "gl", "; ".join([expected, *failures]) + "; or renderer='raycast'")
