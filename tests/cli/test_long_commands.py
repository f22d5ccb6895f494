"""Test every long command as a process with redirected output: progress, and after a kill one line on how to go on."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.helpers.box_rooms import two_rooms
from tests.helpers.imagined_room import room
from tests.helpers.paths import CHECKOUT
from tests.helpers.slam_recordings import write_sequence
from vssm_gym.envs.scenes.scene import save_scene

PATIENCE = 600.0  # s until a line of progress, and from the kill to the end; a busy machine compiles for minutes
OFTEN = "import vssm_gym.cli.shared.progress as p\np.LOG_SECONDS = 0.1\n"
# A suite that runs in the background of a shell inherits an ignored Ctrl-C
HEARD = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
RUN = "import sys\nfrom vssm_gym.cli.main import program\nif __name__ == '__main__':\n    program()"
NOTHING = "no result of this run is kept; start it again with: "
CONFIGS = {
    "sweep.yaml": "scenes: rooms.json\nagents: random\ntasks: 60\n",
    "train.yaml": (
        "name: long\nenvironment: {map: room.npz, num_envs: 8, max_episode_steps: 50, goals: 4, pool: 64}\n"
        "policy: {inputs: [scan, goal], hidden: [8]}\n"
        "algorithm: {name: ppo, n_steps: 8, batch_size: 64, n_epochs: 1}\nsteps: 100000000\n"
    ),
}
# Arguments, the line that is waited for, and what is kept; a compiler works longest where the line is "working".
COMMANDS = {
    "sweep": (
        "sweep {0}/sweep.yaml --workers 1 --out {1}",
        r"progress: running episodes: [1-9]\d* of 60, ",
        r"{1} keeps episodes\.jsonl \([1-9]\d* lines?\); continue with: ",
    ),
    "demo": ("demo --out {1}", "progress: driving and recording: ", NOTHING),
    "record": ("record --scene oak --out {1}", r"progress: driving and recording: \d+ of \d+, ", NOTHING),
    "map build": ("map build {0}/walk --out {1}.npz", "progress: (working|building the map)", NOTHING),
    "slam": (
        "slam {0}/walk --size 80x60 --voxel 0.08 --extent 6.4 --out {1}",
        r"progress: tracking and mapping: \d of 10, \d+\.\d frames/s, 0 lost, ",
        r"{1} keeps trajectory\.partial\.txt \(\d+ lines\); start it again with: ",
    ),
    "train": (
        "train {0}/train.yaml --out {1}",
        r"progress: training: \d+ %, [\d,]+ steps, ",
        r"{1} keeps checkpoint\.pt, policy\.npz; continue with: ",
    ),
    "explore": (
        "explore --scene {0}/rooms.json --agent frontier_nearest --out {1}",
        r"progress: exploring: \d+ of 1,500, ",
        NOTHING,
    ),
    "faults": ("faults slam --out {1}", "progress: (working|SLAM with faults)", NOTHING),
    "study": (
        "study resolution {0}/walk --voxels 0.1 --render-widths 80 --seeds 1 --size 80x60 --out {1}",
        r"progress: (working|.*: \d+ of \d+, )",
        NOTHING,
    ),
    "bench": ("bench tracker --scene {0}/rooms.json --out {1}", "progress: driving and recording: ", NOTHING),
    "navigate": (
        "navigate --scene {0}/rooms.json --start 1,2 --goal 5,2 --agent random --out {1}",
        r"progress: (navigating|video): [1-9]\d* of \d+, ",
        r"(no result of this run is kept|{1} keeps .*run\.json); start it again with: ",
    ),
}
NEEDS = {"train": "stable_baselines3", "explore": "imageio_ffmpeg", "navigate": "imageio_ffmpeg"}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    save_scene(two_rooms(), folder / "rooms.json")
    room().save(folder / "room.npz")
    write_sequence(folder / "walk")
    for name, text in CONFIGS.items():
        (folder / name).write_text(text)
    return folder


def wait_for(process: subprocess.Popen, log: Path, pattern: str) -> None:
    """Wait until the log has a line that begins with a pattern."""
    deadline = time.monotonic() + PATIENCE
    while not re.search(f"^{pattern}", log.read_text(), re.MULTILINE):
        assert process.poll() is None, f"ended before it was killed: {log.read_text()[-2000:]}"
        assert time.monotonic() < deadline, log.read_text()[-2000:]
        time.sleep(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_long_command_shows_progress_and_says_how_to_go_on(inputs, tmp_path, name):
    """Commands and their workers are killed by SIGTERM, as schedulers do, and every other one by Ctrl-C."""
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    number = (signal.SIGTERM, signal.SIGINT)[list(COMMANDS).index(name) % 2]
    words, shown, kept = COMMANDS[name]
    arguments, log = [word.format(inputs, tmp_path / "out") for word in words.split()], tmp_path / "log"
    with log.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-c", OFTEN + HEARD + RUN, *arguments],
            env=os.environ | {"PYTHONPATH": str(CHECKOUT)},
            start_new_session=True,
            stdout=file,
            stderr=file,
        )
    try:
        wait_for(process, log, shown)
        os.killpg(process.pid, number)
        code = process.wait(PATIENCE)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    lines = log.read_text().splitlines()
    assert code == 128 + number, lines[-5:]
    assert all(line.startswith(("progress: ", "warning: ")) for line in lines[:-1]), lines
    assert re.match("interrupted: " + kept.format(inputs, re.escape(str(tmp_path / "out"))), lines[-1]), lines[-1]
    command = ["vssm-gym", *arguments, *(["--resume"] if name in ("sweep", "demo", "train") else [])]
    assert lines[-1].endswith(f" with: {shlex.join(command)}")
