"""Make disks that fill up: a small tmpfs, or for this process the limit on the size of files."""

import contextlib
import resource
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path


@contextlib.contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Refuse bytes beyond ``size`` of every file, as EFBIG; processes that are started meanwhile inherit the limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextlib.contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Callable[[], None] | None]:
    """Mount a tmpfs of ``size`` bytes at ``folder``; yield a function that makes it large, None where none may be."""
    folder.mkdir(exist_ok=True)
    mount = shutil.which("mount")
    done = mount and subprocess.run(
        [mount, "-t", "tmpfs", "-o", f"size={size}", "chaos", folder], capture_output=True, check=False
    )
    if not mount or not done or done.returncode:
        yield None
        return

    def enlarge() -> None:
        subprocess.run([mount, "-o", "remount,size=512m", folder], capture_output=True, check=True)

    try:
        yield enlarge
    finally:
        subprocess.run(["umount", folder], capture_output=True, check=True)


def may_mount(scratch: Path) -> bool:
    """Return whether this process may mount a tmpfs."""
    with small_disk(scratch / "probe", 1 << 20) as enlarge:
        return enlarge is not None
