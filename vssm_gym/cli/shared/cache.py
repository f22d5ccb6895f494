"""Keep compiled functions between runs, so that only the first run of a command waits for the compiler."""

import hashlib
import os
import platform
from pathlib import Path


def cache_folder() -> Path:
    """Return ``$XDG_CACHE_HOME/vssm_gym``, or ``~/.cache/vssm_gym`` where that variable is not set."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vssm_gym"


def use_compilation_cache() -> None:
    """Set the environment variables of JAX's persistent compilation cache; worker processes inherit them.

    Call it before JAX is imported. A variable that is already set keeps its value. Compiled code suits one kind of
    processor only and JAX's key does not name it, so the folder's name does: two machines may share a home folder.
    """
    folder = cache_folder() / "jax" / _processor()
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


def _processor() -> str:
    """Return the architecture and a digest of the processor's instruction sets."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else [platform.processor()]
    flags = next((line for line in lines if line.lower().startswith(("flags", "features"))), "")
    return f"{platform.machine()}-{hashlib.sha256(flags.encode()).hexdigest()[:12]}"
