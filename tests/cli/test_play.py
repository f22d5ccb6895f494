"""Test ``vssm-gym play``: a session without a terminal, and the whole command in a pseudo terminal."""

import contextlib
import math
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from fcntl import ioctl
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from tests.helpers.ansi import pixels
from tests.helpers.paths import CHECKOUT
from vssm_gym.cli.play import play
from vssm_gym.cli.shared.play_session import PLAYABLE, TEXT_LINES, Session, arrow, goal_ahead, planar_pose
from vssm_gym.cli.shared.terminal import ENTER, LEAVE
from vssm_gym.data.sequences import FrameReader, load_sequence
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError

RUN = "import sys; from vssm_gym.cli.main import main; sys.exit(main())"
# A session leader's first terminal becomes its controlling one: Ctrl-C and hang-ups then reach it.
OWN_TERMINAL = "import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0)\n"


def session(record: Path | None = None, **keywords) -> Session:
    env = gym.make("vssm_gym/PointNav-v0", camera=CameraConfig(32, 24), noise="none", **keywords)
    return Session(env, PLAYABLE["PointNav-v0"], "title", record, {"motion": "keyboard"}, seed=0)


def text(lines: list[str]) -> str:
    return re.sub(r"\x1b\[[\d;]*m", "", "\n".join(lines))


@pytest.mark.parametrize("name", PLAYABLE)
def test_every_key_is_an_action_and_is_named_on_the_screen(name):
    env = gym.make(f"vssm_gym/{name}")
    for key in PLAYABLE[name].proportions:
        assert env.action_space.contains(PLAYABLE[name].action(key, env.action_space))
        assert re.search(rf"\b{key}\b", PLAYABLE[name].help)
    env.close()


def test_keys_drive_the_robot():
    """Three turns to the left and a step ahead, by the robot's limits; arrows are letters too."""
    one, other = session(), session()
    for keys, driven in (("aaaw", one), (["left", "left", "left", "up"], other)):
        start = driven.info["start_pose"]
        for key in keys:
            driven.press(key)
        heading = start[2] + 3 * math.radians(11.5)
        ahead = start[:2] + 0.16 * np.array([math.cos(heading), math.sin(heading)])
        assert not driven.collisions
        np.testing.assert_allclose(driven.info["T_world_cam"][:2, 3], ahead, atol=2e-3)
        assert driven.steps == 4


def test_a_key_ends_the_episode_and_r_starts_another():
    driven = session()
    driven.press("space")
    assert "NOT THERE: r for a new task" in text(driven.screen(100, 30))
    driven.press("w")
    assert driven.steps == 1  # nothing moves any more
    task = driven.info.get("task")
    driven.press("r")
    assert (driven.episodes, driven.steps, driven.result) == (2, 0, "")
    assert driven.info["task"] != task
    driven.press("q")
    assert driven.left


def test_the_time_limit_is_shown():
    driven = session(max_episode_steps=2)
    driven.press("s")
    driven.press("s")
    assert "OUT OF TIME" in text(driven.screen(100, 30))
    assert "step 2 of 2" in text(driven.screen(100, 30))


def test_a_maze_is_driven_by_its_plan():
    env = gym.make("vssm_gym/LidarMaze-v0", noise="none", render_mode="rgb_array")
    driven = Session(env, PLAYABLE["LidarMaze-v0"], "title", None, {}, seed=0)
    before = driven.info["pose"]
    screen = text(driven.screen(100, 30))
    assert "goal" in screen and "step 0 of 1000" in screen
    driven.press("a")
    driven.press("up")
    after = driven.info["pose"]
    assert (after[2] - before[2] + math.pi) % (2 * math.pi) - math.pi == pytest.approx(math.radians(30.0))
    assert np.hypot(*(after - before)[:2]) == pytest.approx(0.02)
    driven.press("space")
    assert "NOT THERE" in text(driven.screen(100, 30))
    assert len(driven.screen(100, 30)) > 20


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("Flight-v0",), r"ENV: expected an environment that one key per step can steer \(PointNav-v0, ImageNav-v0"),
        (("LidarMaze-v0", "--record", "somewhere"), "an environment with a camera: LidarMaze-v0 has no images"),
    ],
)
def test_an_environment_that_cannot_be_played_is_refused(arguments, expected):
    with pytest.raises(InputError, match=expected):
        play(arguments[0], record=Path(arguments[2]) if len(arguments) > 1 else None)


def test_arrival_is_shown():
    """The environment's own task places the robot on its goal's side of the room."""
    driven = session()
    sampler = driven.env.unwrapped.sampler
    x, y, _ = driven.info["start_pose"]
    goal = sampler.space.nearest(np.array([x + 0.1, y]))
    task = sampler.task(driven.info["start_pose"], goal)
    driven.observation, driven.info = driven.env.reset(options={"task": task})
    driven.press("space")
    assert "ARRIVED" in text(driven.screen(100, 30))
    assert driven.summary() == ["1 episode, 1 with success"]


def test_the_picture_is_what_the_camera_sees():
    driven = session()
    lines = driven.screen(65, 12 + TEXT_LINES)  # one character a pixel: 32 + 1 + 32
    shown = pixels(lines[:-TEXT_LINES])
    np.testing.assert_array_equal(shown[:, :32], driven.observation["rgb"])
    assert (shown[:, 33:, 0] == shown[:, 33:, 1]).all()  # grey depth
    driven.press("p")
    wide = driven.screen(95, 30)
    assert len(pixels(wide[:-TEXT_LINES])[0]) > 65  # the plan beside them
    robot = (pixels(wide[:-TEXT_LINES])[..., 2].astype(int) - pixels(wide[:-TEXT_LINES])[..., 0] > 100).sum()
    assert robot >= 2


@pytest.mark.parametrize(
    ("bearing", "expected"),
    [(0.0, "↑"), (0.3, "↑"), (0.8, "↖"), (1.6, "←"), (-0.8, "↗"), (-1.6, "→"), (3.1, "↓"), (-3.1, "↓"), (2.4, "↙")],
)
def test_arrows(bearing, expected):
    assert arrow(bearing) == expected


def test_the_goal_by_hand():
    """A camera at (1, 2) looking along +y: (1, 5) is 3 m ahead, (0, 2) is 1 m to the left, (1, 0) behind."""
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # right +x, down -z, ahead +y
    T[:2, 3] = 1.0, 2.0
    planar = planar_pose(T)
    np.testing.assert_allclose(planar, [1.0, 2.0, math.pi / 2])
    assert goal_ahead(planar, np.array([1.0, 5.0])) == pytest.approx((3.0, 0.0))
    assert goal_ahead(planar, np.array([0.0, 2.0])) == pytest.approx((1.0, math.pi / 2))
    distance, bearing = goal_ahead(planar, np.array([1.0, 0.0]))
    assert (distance, abs(bearing)) == pytest.approx((2.0, math.pi))


def test_every_played_episode_is_a_recording(tmp_path):
    """Each episode has a folder with its commands; one without a step leaves none, an unfinished one is kept."""
    driven = session(tmp_path / "out")
    for key in "wwarrdd":
        driven.press(key)
    driven.close()
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["1", "3"]
    first = load_sequence(tmp_path / "out" / "1")
    assert len(first.frames) == 4
    np.testing.assert_allclose(
        first.controls[:, 1:], [[0, 0, 0], [0, 0, 0.16], [0, 0, 0.16], [0.200713, 0, 0]], atol=1e-5
    )
    assert len(load_sequence(tmp_path / "out" / "3").frames) == 3
    rgb, depth = FrameReader(load_sequence(tmp_path / "out" / "3"))[2]
    np.testing.assert_array_equal(rgb, driven.observation["rgb"])
    np.testing.assert_allclose(depth, driven.observation["depth"], atol=2e-4)
    assert driven.summary()[1:] == [f"recorded: {tmp_path / 'out' / n}" for n in "13"]


class Screen:
    """Run the program in a pseudo terminal of 100 x 30 characters, and keep its output."""

    def __init__(self, process: subprocess.Popen, master: int, slave: int) -> None:
        self.process, self.master, self.slave, self.written = process, master, slave, ""

    def wait_for(self, expected: str) -> str:
        """Read until ``expected`` was written; return the output without escape sequences."""
        seen = ""
        deadline = time.monotonic() + 120.0  # against hanging for ever, no claim about speed
        while expected not in re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "", seen):
            assert time.monotonic() < deadline, seen[-2000:]
            assert self.process.poll() is None, seen[-2000:]
            if select.select([self.master], [], [], 0.2)[0]:
                seen += self._read()
        return seen

    def end(self) -> int:
        """Read until the program has ended; return its exit code."""
        deadline = time.monotonic() + 120.0
        while self.process.poll() is None or select.select([self.master], [], [], 0.1)[0]:
            assert time.monotonic() < deadline, self.written[-2000:]
            if select.select([self.master], [], [], 0.1)[0]:
                self._read()
        return self.process.returncode

    def type(self, keys: str) -> None:
        os.write(self.master, keys.encode())

    def _read(self) -> str:
        received = os.read(self.master, 65536).decode("utf-8", "replace")
        self.written += received
        return received


@contextlib.contextmanager
def terminal(*arguments: str, before_it: str = "") -> Iterator[Screen]:
    """Run ``vssm-gym play ARGUMENTS`` (after the statements ``before_it``) in a pseudo terminal of its own."""
    master, slave = pty.openpty()
    ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 100, 0, 0))
    before = termios.tcgetattr(slave)

    process = subprocess.Popen(
        [sys.executable, "-c", OWN_TERMINAL + before_it + RUN, "play", *arguments],
        stdin=slave,
        stdout=slave,
        stderr=slave,
        cwd=CHECKOUT,
        env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # background jobs inherit that it is ignored
    )
    screen = Screen(process, master, slave)
    try:
        yield screen
        assert termios.tcgetattr(slave) == before  # echo, lines, Ctrl-Z: all as it was
        assert screen.written.count(ENTER) == screen.written.count(LEAVE) == 1
        assert screen.written.index(ENTER) < screen.written.index(LEAVE)
    finally:
        process.kill()
        process.wait()
        os.close(master)
        os.close(slave)


def test_a_person_drives_and_quits(tmp_path):
    with terminal("--size", "32x24", "--noise", "none", "--record", str(tmp_path / "driven")) as screen:
        assert "▀" in screen.wait_for("q quit")
        screen.type("w")
        screen.wait_for("step 1 of 500")
        screen.type("\x1b[Daa")
        screen.wait_for("step 4 of 500")
        screen.type("p")
        screen.type(" ")
        screen.wait_for("NOT THERE")
        screen.type("r")
        screen.wait_for("episode 2   step 0")
        screen.type("q")
        assert screen.end() == 0
    after = screen.written.split(LEAVE)[1]
    assert "2 episodes, 0 with success" in after
    recorded = load_sequence(tmp_path / "driven" / "1")
    assert len(recorded.frames) == 6
    assert not (tmp_path / "driven" / "2").exists()


@pytest.mark.parametrize(
    ("how", "code"),
    [
        ("ctrl-c", 130),
        pytest.param("SIGTERM", 128 + 15, marks=pytest.mark.slow),
        pytest.param("hang up", 128 + 1, marks=pytest.mark.slow),
    ],
)
def test_the_terminal_is_restored_however_it_ends(tmp_path, how, code):
    """The recording up to that moment is kept."""
    with terminal("--size", "32x24", "--record", str(tmp_path / "driven")) as screen:
        screen.wait_for("q quit")
        screen.type("w")
        screen.wait_for("step 1")
        if how == "ctrl-c":
            screen.type("\x03")
        else:
            screen.process.send_signal(signal.SIGTERM if how == "SIGTERM" else signal.SIGHUP)
        assert screen.end() == code
    assert "Traceback" not in screen.written
    assert len(load_sequence(tmp_path / "driven" / "1").frames) == 2


@pytest.mark.slow
def test_the_terminal_is_restored_after_an_error():
    """An error of the program itself, in the middle of the drive, is shown on a terminal that shows it."""
    broken = (
        "from vssm_gym.cli.shared import play_session as p\n"
        "def fail(*_): raise RuntimeError('a bug')\n"
        "p.Session._step = fail\n"
    )
    with terminal("--size", "32x24", before_it=broken) as screen:
        screen.wait_for("q quit")
        screen.type("w")
        assert screen.end() == 1
    assert "RuntimeError: a bug" in screen.written.split(LEAVE)[1]


@pytest.mark.parametrize("arguments", [(), ("--record", "somewhere")])
def test_without_a_terminal_there_is_one_line(tmp_path, arguments):
    done = subprocess.run(
        [sys.executable, "-c", RUN, "play", *arguments],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
    )
    assert done.returncode == 2
    assert (done.stdout, done.stderr.count("\n")) == ("", 1)
    assert done.stderr.startswith("error: play: stdin: expected a terminal")
    assert list(tmp_path.iterdir()) == []
