"""Test the viewer's stream: frames arrive in a recording, and without rerun an error says how to install it."""

import subprocess
import sys

import numpy as np
import pytest

from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.viz.mesh import Mesh
from vssm_gym.viz.stream import open_viewer

CAMERA = Camera.from_hfov(16, 12, 1.2)
TRIANGLE = Mesh(np.eye(3), np.array([[0, 1, 2]]), np.full((3, 3), 200, np.uint8), np.zeros(3))
NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8), np.zeros(0))


def show(file, frames: int, mesh: Mesh = TRIANGLE) -> list[str]:
    """Stream some frames into a file; return the lines of rerun's own print of it."""
    pytest.importorskip("rerun", reason="the extra viz is not installed")
    viewer = open_viewer("test", CAMERA, file)
    for i in range(frames):
        T = np.eye(4)
        T[0, 3] = 0.1 * i
        rgb, depth = np.zeros((12, 16, 3), np.uint8), np.ones((12, 16), np.float32)
        viewer.frame(100.0 + 0.1 * i, T, rgb, depth, lost=i == 3, step_ms=20.0)
    viewer.surface(mesh)
    viewer.close()
    # Through the module, as the console script of a virtual environment need not be on the path.
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-v", str(file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    return done.stdout.splitlines()


def test_everything_arrives(tmp_path):
    text = "\n".join(show(tmp_path / "run.rrd", 12))
    for entity in ("/world/camera/image/colour", "/world/camera/image/depth", "/world/path", "/world/surface"):
        assert entity in text
    for entity in ("/world/position", "/step_ms", "/world/camera"):
        assert entity in text


def test_an_empty_surface_and_a_short_path_are_not_drawn(tmp_path):
    text = "\n".join(show(tmp_path / "run.rrd", 1, NOTHING))
    assert "/world/camera" in text
    assert "/world/surface" not in text
    assert "/world/path" not in text


def test_an_empty_stream(tmp_path):
    assert "/world/path" not in "\n".join(show(tmp_path / "run.rrd", 0, NOTHING))


def test_without_the_extra_the_error_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"--viewer: rerun: expected .*'\.\[viz\]'"):
        open_viewer("test", CAMERA)


def test_a_file_that_cannot_be_written_is_refused(tmp_path):
    pytest.importorskip("rerun", reason="the extra viz is not installed")
    with pytest.raises(InputError, match="--viewer"):
        open_viewer("test", CAMERA, tmp_path / "none" / "run.rrd")
