"""Compute with AVX2 and nothing wider, so that a seed gives the same numbers on x86-64 processors of several kinds.

NumPy and OpenBLAS (in NumPy and SciPy) choose the widest instructions that a processor has, and sum in an order that
follows from them. The last digit differs then, and an episode of some hundred steps ends elsewhere. With AVX2 alone
episodes repeat (``vssm-gym reproduce``). Numba and XLA keep their choice, which changes no bit of their results as
long as no kernel allows the compiler to reorder sums (``fastmath``).

Each library reads its variable when it is loaded: where NumPy was imported before ``vssm_gym``, it keeps its choice.
"""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

CPU_FILE = Path("/proc/cpuinfo")  # of Linux
NEEDED = {"avx2", "fma", "bmi2", "movbe"}  # what Haswell's code may contain
KERNELS = ("OPENBLAS_CORETYPE", "Haswell")
DISPATCHED = "NPY_DISABLE_CPU_FEATURES"
AVX512 = "X86_V4 AVX512_ICL AVX512_SPR"
AVX512_BEFORE_2_4 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR"


def use_common_instructions() -> None:
    """Set the variables of NumPy and OpenBLAS, for this process and those that it starts.

    A variable that is set keeps its value. Nothing is set on a processor without AVX2, or that Linux does not
    describe.
    """
    if platform.machine() != "x86_64" or not set(cpu_flags().split()) >= NEEDED:
        return
    for name, value in (KERNELS, (DISPATCHED, _numpy_features())):
        os.environ.setdefault(name, value)


def cpu_flags() -> str:
    """Return the line of ``/proc/cpuinfo`` with the processor's instruction sets; empty where there is none."""
    return next((line for line in _cpu_lines() if line.lower().startswith(("flags", "features"))), "")


def cpu_model() -> str:
    """Return the model of the processor; the architecture where the system does not tell."""
    named = (line.partition(":")[2].strip() for line in _cpu_lines() if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _cpu_lines() -> list[str]:
    try:
        return CPU_FILE.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return []


def _numpy_features() -> str:
    """Return NumPy's names of what AVX2 lacks, which are others since 2.4; NumPy itself is not loaded yet."""
    try:
        major, minor = (int(part) for part in version("numpy").split(".")[:2])
    except (PackageNotFoundError, ValueError):
        return AVX512
    return AVX512 if (major, minor) >= (2, 4) else AVX512_BEFORE_2_4
