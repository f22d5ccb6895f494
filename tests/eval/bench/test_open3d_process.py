"""Test the protocol with Open3D's process, on processes that answer, end early, write nothing or write nonsense."""

import sys

import numpy as np
import pytest

from vssm_gym.errors import InputError
from vssm_gym.eval.bench.open3d_process import COMMAND, run_open3d
from vssm_gym.geometry.camera import Camera

CAMERA = Camera.from_hfov(8, 6, 1.0)
PIXELS = 48
FRAMES = [(np.full((6, 8, 3), k, np.uint8), np.full((6, 8), 0.5 * k, np.float32)) for k in range(5)]

# What the real program does, without the library: a pose that holds what it was sent.
BEGIN = f"""
import json, os, signal, sys, time
setup = json.loads(sys.stdin.buffer.readline())
def say(answer): print(json.dumps(answer), flush=True)
def frame(): return sys.stdin.buffer.read(7 * {PIXELS})
"""
ANSWER = """
import struct
n = 0
say({"version": "0.1"})
while len(data := frame()) == 7 * %d:
    red, depth = data[0], struct.unpack_from("f", data, 3 * %d)[0]
    pose = [[1, 0, 0, red], [0, 1, 0, depth], [0, 0, 1, setup["voxel"]], [0, 0, 0, 1]]
    say({"pose": pose, "failed": red == 2, "seconds": [0.1, 0.2, 0.3]})
    n += 1
    %s
"""


def standing_in(code):
    return (sys.executable, "-c", BEGIN + code)


def answering(more="pass"):
    return standing_in(ANSWER % (PIXELS, PIXELS, more))


def run(command, **keywords):
    return run_open3d(iter(FRAMES), CAMERA, 0.03, 8.0, command=command, **keywords)


def test_frames_and_answers_pass_unchanged():
    heard = []
    found = run(answering(), on_progress=lambda *event: heard.append(event))
    assert found.version == "0.1"
    np.testing.assert_array_equal(found.poses[:, 0, 3], range(5))
    np.testing.assert_allclose(found.poses[:, 1, 3], [0.0, 0.5, 1.0, 1.5, 2.0])
    np.testing.assert_allclose(found.poses[:, 2, 3], 0.03)
    np.testing.assert_allclose(found.seconds, np.tile([0.1, 0.2, 0.3], (5, 1)))
    assert found.failed == 1
    assert heard == [("0.1", n) for n in range(1, 6)]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (answering("n == 3 and os.kill(os.getpid(), signal.SIGSEGV)"), ".*killed by SIGSEGV after 3 frames"),
        (answering("n == 2 and sys.exit('out of blocks')"), r".*exit code 1 after 2 frames \(out of blocks\)"),
        (standing_in("os.kill(os.getpid(), signal.SIGKILL)"), ".*killed by SIGKILL after 0 frames"),
        (
            standing_in("print('hello', flush=True); time.sleep(60)"),
            ".*gave an answer that cannot be read after 0 frames",
        ),
        (standing_in("print('[]', flush=True); time.sleep(60)"), ".*gave an answer that cannot be read after 0 frames"),
        (standing_in("say({'version': '1'}); say({'pose': 1}); time.sleep(60)"), ".*cannot be read after 0 frames"),
        (standing_in("say({'error': 'pip install it'})"), "expected pip install it$"),
    ],
)
def test_a_process_that_does_not_answer_to_the_end_is_one_clear_error(command, message):
    with pytest.raises(InputError, match=f"bench slam: open3d: {message}") as caught:
        run(command)
    assert "\n" not in str(caught.value)


def test_the_programs_error_names_the_installation(tmp_path, monkeypatch):
    (tmp_path / "open3d.py").write_text("raise OSError('libGL.so.1: cannot open shared object file')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match=r"open3d: expected Open3D: pip install open3d.*Debian.*\(libGL"):
        run(COMMAND)


# The library itself, as little of it as the program calls: what it prints does not become an answer.
STUB = """
import types, numpy as np
print("loaded from C++")
class Tensor:
    def __init__(self, a): self.a = a
    def numpy(self): return self.a
class Frame:
    def __init__(self, height, width, K, device): self.size = height, width
    def set_data_from_image(self, name, image): print("set", name)
class Model:
    def __init__(self, voxel, blocks, n, T, device): self.k = 0
    def track_frame_to_model(self, seen, cast, units, far, jump):
        self.k += 1
        if self.k == 2: raise RuntimeError("singular")
        T = np.eye(4); T[0, 3] = 0.5
        return types.SimpleNamespace(transformation=Tensor(T))
    def update_frame_pose(self, n, T): pass
    def integrate(self, *a): pass
    def synthesize_model_frame(self, *a): pass
ns = types.SimpleNamespace
utility = ns(set_verbosity_level=lambda level: None, VerbosityLevel=ns(Error=0))
core = ns(Tensor=Tensor, Device=lambda name: name)
t = ns(pipelines=ns(slam=ns(Model=Model, Frame=Frame)), geometry=ns(Image=lambda tensor: tensor))
__version__ = "stub"
"""


def test_the_program_chains_the_librarys_motions_and_keeps_the_last_pose_where_it_fails(tmp_path, monkeypatch):
    (tmp_path / "open3d.py").write_text(STUB)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    found = run(COMMAND)
    assert found.version == "stub"
    np.testing.assert_allclose(found.poses[:, 0, 3], [0.0, 0.5, 0.5, 1.0, 1.5])
    assert found.failed == 1
    assert (found.seconds >= 0.0).all()
