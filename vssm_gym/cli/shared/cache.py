"""Where compiled functions are kept between runs, so that only the first run of a command waits for the compiler."""

import hashlib
import os
import platform
from pathlib import Path


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/vssm_gym``, else ``~/.cache/vssm_gym``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vssm_gym"


def use_compilation_cache() -> None:
    """Point JAX at a persistent cache through the environment: call it before JAX is imported; workers inherit it.

    What a variable already says is kept. Compiled code serves one kind of processor only, and JAX's key does not name
    it, so the folder does: a home folder shared by two machines is safe.
    """
    folder = cache_folder() / "jax" / _processor()
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


def _processor() -> str:
    """The architecture and a digest of the instruction sets that the processor has."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else [platform.processor()]
    flags = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:12]}"
