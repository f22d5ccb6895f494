"""Keep compiled functions between processes, so that only the first one on a machine waits for the compiler.

Importing ``vssm_gym`` turns JAX's persistent compilation cache on. JAX's own variables are the switch:
``JAX_ENABLE_COMPILATION_CACHE=false`` turns it off, ``JAX_COMPILATION_CACHE_DIR`` puts it elsewhere.
"""

import os
import platform
import sys
import zlib
from pathlib import Path

from vssm_gym.instruction_set import cpu_flags

# JAX's defaults keep what took a second to compile: a process here compiles a hundred functions, most of them small.
SETTINGS = {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1"}
FOLDER = "JAX_COMPILATION_CACHE_DIR"


def cache_folder() -> Path:
    """Return ``$XDG_CACHE_HOME/vssm_gym``, or ``~/.cache/vssm_gym`` where that variable is not set."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vssm_gym"


def use_compilation_cache() -> None:
    """Turn the cache on, in this process and in those that it starts, unless its owner has configured one.

    A variable that is set keeps its value. Where JAX has been imported already, its configuration is set instead if no
    folder is configured. Nothing is done where no folder can be written.
    """
    if FOLDER in os.environ:
        return
    try:
        folder = cache_folder() / "jax" / _processor()
    except RuntimeError:  # no home folder
        return
    if not _writable(folder):
        return
    for name, value in {FOLDER: str(folder), **SETTINGS}.items():
        os.environ.setdefault(name, value)
    if "jax" in sys.modules:
        _configure(str(folder))


def _configure(folder: str) -> None:
    """Set what JAX would have read from the environment at its import."""
    import jax

    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", folder)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _writable(folder: Path) -> bool:
    """Return whether a folder is there or can be made, and written to."""
    nearest = next(path for path in (folder, *folder.parents) if path.exists())
    return nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)


def _processor() -> str:
    """Return the architecture and a digest of the processor's instruction sets.

    Compiled code suits one kind of processor, which JAX's key does not name, and machines may share a home folder.
    """
    return f"{platform.machine()}-{zlib.crc32((cpu_flags() or platform.processor()).encode()):08x}"
