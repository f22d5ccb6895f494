"""Test the window: what opens and closes it, its frame rate, size and errors, and the picture on a real X server."""

import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from vssm_gym.envs.rendering import window
from vssm_gym.envs.rendering.window import Window
from vssm_gym.errors import InputError

PICTURE = np.random.default_rng(0).integers(0, 256, (60, 100, 3), dtype=np.uint8)
SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")  # variables that say where a window may open


@pytest.fixture
def pygame():
    module = pytest.importorskip("pygame", reason="the human extra is not installed")
    yield module
    module.display.quit()


def shown(pygame) -> np.ndarray:
    return pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)


def test_it_opens_with_the_first_picture_and_shows_each(pygame):
    one = Window()
    one.close()
    assert not pygame.display.get_init()
    for picture in (PICTURE, PICTURE[::-1]):
        assert one.show(picture, "Room", 1e6)
        np.testing.assert_array_equal(shown(pygame), picture)
    assert pygame.display.get_caption()[0] == "Room"
    one.close()
    assert not pygame.display.get_init()
    assert one.show(PICTURE, "Room", 1e6)  # a closed one opens again


def test_the_picture_fits_a_resized_window(pygame):
    one, squares = Window(), PICTURE[::20, ::20].repeat(20, axis=0).repeat(20, axis=1)
    one.show(squares, "Room", 1e6)
    pygame.display.set_mode((300, 120), pygame.RESIZABLE)
    one.show(squares, "Room", 1e6)
    screen = shown(pygame).astype(int)
    assert (screen[:, :50] == window.BACKGROUND).all() and (screen[:, 250:] == window.BACKGROUND).all()
    np.testing.assert_allclose(screen[20::40, 70:250:40], squares[10::20, 10::20], atol=2)  # centres of the squares


@pytest.mark.parametrize("button", ["QUIT", "ESCAPE"])
def test_the_close_button_and_escape_are_reported(pygame, button):
    one = Window()
    one.show(PICTURE, "Room", 1e6)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_a))
    assert one.show(PICTURE, "Room", 1e6)
    if button == "QUIT":
        pygame.event.post(pygame.event.Event(pygame.QUIT))
    else:
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))
    assert not one.show(PICTURE, "Room", 1e6)


def test_pictures_follow_each_other_at_the_frame_rate(pygame, monkeypatch):
    """The pause is what the work between two pictures leaves of the period; none follows a long step."""
    now, pauses = [100.0], []

    def sleep(seconds: float) -> None:
        pauses.append(seconds)
        now[0] += seconds

    monkeypatch.setattr(window.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(window.time, "sleep", sleep)
    one = Window()
    for work in (0.0, 0.05, 0.0, 0.7, 0.01):
        now[0] += work
        one.show(PICTURE, "Room", 5.0)
    np.testing.assert_allclose(pauses, [0.0, 0.15, 0.2, 0.0, 0.19], atol=1e-9)


def test_a_process_has_one_window(pygame):
    one, other = Window(), Window()
    one.show(PICTURE, "Room", 1e6)
    with pytest.raises(InputError, match="Hall: render_mode: expected at most one window in a process"):
        other.show(PICTURE, "Hall", 1e6)
    other.close()
    assert one.show(PICTURE, "Room", 1e6)
    one.close()
    assert other.show(PICTURE, "Hall", 1e6)


def test_without_pygame_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(InputError, match=r"Room: render_mode: .*pip install -c constraints.txt '\.\[human\]'"):
        Window().show(PICTURE, "Room", 5.0)


def run(code: str, **variables: str) -> subprocess.CompletedProcess:
    kept = {name: value for name, value in os.environ.items() if name not in SCREENS}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=kept | variables, capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize("variables", [{}, {"DISPLAY": ":4711"}, {"SDL_VIDEODRIVER": "cathode"}])
def test_without_a_display_there_is_one_error(pygame, variables):
    code = """
import numpy as np
from vssm_gym.envs.rendering.window import Window
from vssm_gym.errors import InputError
try:
    Window().show(np.zeros((40, 60, 3), np.uint8), "Room", 5.0)
except InputError as error:
    print(error)
"""
    done = run(code, **variables)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("Room: render_mode: expected a display for 'human'")
    assert len(done.stdout.splitlines()) == 1


# A program of a user: LidarMaze in a window until Escape. It prints "shown" and waits before it looks for keys.
PROGRAM = """
import sys
import gymnasium as gym
import numpy as np
import vssm_gym
env = gym.make("vssm_gym/LidarMaze-v0", render_mode="human")
env.reset(seed=0)
env.step(np.zeros(3, np.float32))
same = gym.make("vssm_gym/LidarMaze-v0", render_mode="rgb_array", captions=True)
same.reset(seed=0)
same.step(np.zeros(3, np.float32))
np.save(sys.argv[1], same.render())
import pygame
print(pygame.display.get_driver(), flush=True)
sys.stdin.readline()
pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))
try:
    for _ in range(10):
        env.step(np.zeros(3, np.float32))
finally:
    print("cleaned up", flush=True)
print("never reached", flush=True)
"""


def screenshot(dump: Path) -> np.ndarray:
    """Read the frame buffer of Xvfb, an XWD file of 32 bits a pixel: uint8 ``(height, width, 3)``."""
    data = dump.read_bytes()
    header = struct.unpack(">25I", data[:100])
    start, width, height, stride = header[0] + 12 * header[19], header[4], header[5], header[12]
    pixels = np.frombuffer(data, np.uint8, height * stride, start).reshape(height, stride // 4, 4)
    return pixels[:, :width, 2::-1]  # blue comes first


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("Xvfb") is None, reason="Xvfb, an X server without a screen, is not installed")
def test_a_window_on_an_x_server_shows_the_picture_until_escape(pygame, tmp_path):
    read, write = os.pipe()
    where = ["-displayfd", str(write), "-fbdir", str(tmp_path), "-nolisten", "tcp"]
    command = ["Xvfb", "-screen", "0", "800x700x24", *where]
    server = subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as answer:
            display = f":{answer.readline().strip()}"
        kept = {name: value for name, value in os.environ.items() if name not in SCREENS}
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(tmp_path / "picture.npy")],
            env=kept | {"DISPLAY": display},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert program.stdout is not None
        assert program.stdout.readline() == "x11\n"
        screen, picture = screenshot(tmp_path / "Xvfb_screen0"), np.load(tmp_path / "picture.npy")
        rest, _ = program.communicate("on\n", timeout=60)
    finally:
        server.terminate()
        server.wait()
    left, top = (800 - picture.shape[1]) // 2, (700 - picture.shape[0]) // 2  # SDL opens it in the middle
    np.testing.assert_array_equal(screen[top : top + len(picture), left : left + picture.shape[1]], picture)
    assert program.returncode == 0 and rest == "cleaned up\n"
