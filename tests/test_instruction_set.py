"""Test that libraries compute with the instructions that every processor has, unless their user has chosen others."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from vssm_gym import instruction_set
from vssm_gym.instruction_set import (
    AVX512,
    AVX512_BEFORE_2_4,
    DISPATCHED,
    KERNELS,
    cpu_flags,
    use_common_instructions,
)

SETTINGS = {KERNELS[0], DISPATCHED}
HASWELL = "flags\t\t: fpu sse4_2 movbe avx fma bmi1 avx2 bmi2"
OLDER = "flags\t\t: fpu sse4_2 avx"


@pytest.fixture
def processor(monkeypatch, tmp_path):
    """Let the process run on a processor of other instruction sets, without settings."""

    def set_to(flags: str, architecture: str = "x86_64") -> None:
        (tmp_path / "cpuinfo").write_text(f"processor\t: 0\nmodel name\t: A name: of ours\n{flags}\n")
        monkeypatch.setattr(instruction_set, "CPU_FILE", tmp_path / "cpuinfo")
        monkeypatch.setattr(instruction_set.platform, "machine", lambda: architecture)
        monkeypatch.setattr(instruction_set.os, "environ", {})

    return set_to


def test_a_processor_with_avx2_gets_the_settings(processor):
    processor(HASWELL)
    use_common_instructions()
    assert set(instruction_set.os.environ) == SETTINGS
    assert instruction_set.cpu_model() == "A name: of ours"


@pytest.mark.parametrize(("flags", "architecture"), [(OLDER, "x86_64"), (HASWELL, "aarch64"), ("", "x86_64")])
def test_another_processor_keeps_its_own(flags, architecture, processor):
    processor(flags, architecture)
    use_common_instructions()
    assert not instruction_set.os.environ


def test_a_variable_that_is_set_keeps_its_value(processor):
    processor(HASWELL)
    instruction_set.os.environ["OPENBLAS_CORETYPE"] = "Zen"
    use_common_instructions()
    assert instruction_set.os.environ["OPENBLAS_CORETYPE"] == "Zen"
    assert set(instruction_set.os.environ) == SETTINGS


def test_a_machine_that_tells_nothing_has_an_architecture(monkeypatch, tmp_path):
    monkeypatch.setattr(instruction_set, "CPU_FILE", tmp_path / "no file")
    monkeypatch.setattr(instruction_set.platform, "processor", lambda: "")
    monkeypatch.setattr(instruction_set.platform, "machine", lambda: "riscv64")
    assert (instruction_set.cpu_flags(), instruction_set.cpu_model()) == ("", "riscv64")


@pytest.mark.parametrize(
    ("found", "names"), [("2.4.6", AVX512), ("3.0.0rc1", AVX512), ("2.2.0", AVX512_BEFORE_2_4), ("unknown", AVX512)]
)
def test_numpy_is_told_in_its_own_words(found, names, processor, monkeypatch):
    processor(HASWELL)
    monkeypatch.setattr(instruction_set, "version", lambda name: found)
    use_common_instructions()
    assert instruction_set.os.environ[DISPATCHED] == names


@pytest.mark.skipif("avx512f" not in cpu_flags().split(), reason="nothing is wider than AVX2 on this processor")
@pytest.mark.parametrize("code", ["import vssm_gym", "import vssm_gym.cli.main"])
def test_numpy_leaves_wider_instructions_alone(code):
    """In a new process, as its users start it."""
    program = f"""
{code}
import warnings
warnings.simplefilter("error")  # NumPy warns of names that it does not know
import numpy as np
from numpy._core._multiarray_umath import __cpu_features__ as features, __cpu_dispatch__ as dispatched
print(*[name for name in dispatched if features[name]])
"""
    used = printed(program).split()
    assert used
    assert not [name for name in used if "512" in name or name == "X86_V4"]


def test_no_kernel_lets_the_compiler_reorder_sums():
    """Such a kernel's results depend on how many numbers an instruction takes."""
    package = Path(instruction_set.__file__).parent
    files = [path for part in (".", "agents", "eval") for path in (package / part).rglob("*.py")]
    assert len(files) > 500
    assert not [path for path in files if "fastmath=" in path.read_text()]


DRIVE = """
import vssm_gym, hashlib
import gymnasium as gym, numpy as np
digest = hashlib.sha256()
for sensor_noise in ("kinect", "stereo"):
    env = gym.make("vssm_gym/PointNav-v0", scene="oak", noise="high", sensor_noise=sensor_noise)
    observation, _ = env.reset(seed=0)
    for k in range(40):
        observation, *_ = env.step(np.array([0.6, 0.0, np.sin(k / 5), 0.0], np.float32))
        for name in sorted(observation):
            digest.update(np.ascontiguousarray(observation[name]).tobytes())
print(digest.hexdigest())
"""


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() != "x86_64", reason="names of other processors")
def test_images_and_their_noise_have_the_same_bits_on_every_processor(tmp_path):
    """Numba compiles for this processor, and for one without AVX: the same drive shows the same images."""
    assert printed(DRIVE, NUMBA_CPU_NAME="generic", NUMBA_CACHE_DIR=str(tmp_path)) == printed(DRIVE)


def printed(program: str, **variables: str) -> str:
    """Return what a new process prints, without the settings of this one."""
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS} | variables
    command = [sys.executable, "-c", program]
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.strip()
