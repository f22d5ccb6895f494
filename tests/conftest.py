"""Set up what tests share: checked shapes, a compilation cache, bounded threads, repeatable hypothesis, shared data.

This file runs before any test module, so what it sets in the environment is seen by JAX, numba and by spawned workers.
The order matters: libraries read the thread counts when they load, and only what is imported after the hook is checked.
"""

import gc
import os
import re
import sys
from argparse import ArgumentTypeError
from collections.abc import Callable, Iterator
from pathlib import Path

# Under xdist each worker gets its share of the cores instead of all of them. Kept to them, XLA starts no more threads:
# two workers with a thread for every core each wait for one another at every small operation.
if workers := os.environ.get("PYTEST_XDIST_WORKER_COUNT"):
    share = str(max(1, (os.cpu_count() or 1) // int(workers)))
    if hasattr(os, "sched_setaffinity"):
        cores, number = sorted(os.sched_getaffinity(0)), int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw"))
        os.sched_setaffinity(0, cores[number % len(cores) :: int(workers)])
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS"):
        os.environ.setdefault(variable, share)
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # windows are drawn, and seen nowhere

# One compilation of a function serves both xdist workers, the processes that tests start, the slow tests and every
# later run. Tests compile hundreds of small functions: they are kept too.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import vssm_gym  # noqa: F401, I001  (first: it turns the cache on before JAX reads its settings)
import jax
import pytest
from hypothesis import HealthCheck, Phase, settings
from jaxtyping import install_import_hook

from tests.helpers.parts import files_in_turn

FORGET_ABOVE = 4e9  # bytes of a test process
QUICK_EMITTERS = "--xla_cpu_use_fusion_emitters=false"

# Functions that JAX traces are made of many small objects, few of which are in cycles. Looking for those after every
# 700 objects, the default, takes a tenth of the time of tests that compile (212 instead of 187 s of three files).
gc.set_threshold(50_000, 20, 20)

# Annotated shapes and dtypes of these modules are checked at every call. Simulation and planning are left
# out: their inner loops are compiled by numba, which cannot compile a checked function.
CHECKED = ["geometry.transforms", "geometry.camera", "maps", "model", "inference"]

already_imported = [name for name in CHECKED if f"vssm_gym.{name}" in sys.modules]
if already_imported:
    raise RuntimeError(f"imported before the shape checks were installed: {already_imported}")
install_import_hook([f"vssm_gym.{name}" for name in CHECKED], "beartype.beartype")

# Shrinking a failure can take minutes: worth it at a desk, not in CI, where the failure itself is enough.
phases = [phase for phase in Phase if phase is not Phase.shrink or "CI" not in os.environ]
settings.register_profile(
    "vssm_gym",
    max_examples=25,
    deadline=None,
    derandomize=True,
    phases=phases,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("vssm_gym")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add ``--part K/N``."""
    parser.addoption("--part", type=part_of_all, help="K/N: run the test files of the Kth of N parts alone")


def part_of_all(text: str) -> tuple[int, int]:
    """Return K and N of ``K/N``; argparse's error where it is none."""
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise ArgumentTypeError(f"expected K/N with 1 <= K <= N; found {text!r}")
    return int(found[1]), int(found[2])


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Read only the files of the part that was asked for, which are the same ones on every machine."""
    if not (part := config.option.part) or not collection_path.name.startswith("test_") or collection_path.is_dir():
        return None
    turn = files_in_turn(config.rootpath).index(collection_path.relative_to(config.rootpath).as_posix())
    return turn % part[1] != part[0] - 1 or None


def pytest_configure(config: pytest.Config) -> None:
    """Let XLA compile quickly rather than well, and with ``-m slow`` only where the compiled code is hardly slower.

    Without a cache most of the time of the fast tests is the compiler's. With these settings it takes a quarter of that
    (a renderer: 1.8 s instead of 7.3 s) for code half as fast. The slow tests run long enough to be optimised
    (four files of them: 224 s of a core with the quick emitters, 312 s without them). XLA reads the environment when it
    compiles for the first time; processes that tests start inherit it.
    """
    known = jax.__version_info__ < (0, 11)  # XLA ends the process at a flag that it does not know
    if known and QUICK_EMITTERS not in os.environ.get("XLA_FLAGS", ""):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {QUICK_EMITTERS}".strip()
    if config.option.markexpr != "slow":
        os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
        jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of recordings and houses beside the checkout; skip the test without it."""
    from tests.helpers.paths import SHARED_DATA

    if not SHARED_DATA.is_dir():
        pytest.skip("no recordings beside the checkout")
    return SHARED_DATA


@pytest.fixture
def vssm(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[int | str, str, str]]:
    """Run the console script in this process: ``vssm("doctor", "--help") -> (exit code, stdout, stderr)``."""
    from vssm_gym.cli import main as main_module

    def run(*arguments: object) -> tuple[int | str, str, str]:
        monkeypatch.setattr(sys, "argv", ["vssm-gym", *map(str, arguments)])
        try:
            code: int | str = main_module.main()
        except SystemExit as stop:
            code = stop.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture(scope="module")
def quick_compilation() -> Iterator[None]:
    """Compile as for the fast tests, in a module whose slow tests compile for longer than they run."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture(scope="module", autouse=True)
def bounded_memory() -> Iterator[None]:
    """Drop compiled functions between modules once they need gigabytes; the cache on disk keeps them."""
    yield
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        if pages * os.sysconf("SC_PAGE_SIZE") > FORGET_ABOVE:
            jax.clear_caches()
