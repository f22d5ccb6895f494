"""List the formats of data sets; ``vssm-gym dataset export`` and tests read this table."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from vssm_gym.data.datasets.arrow_tables import load_arrow
from vssm_gym.data.datasets.episode import Description, Episode
from vssm_gym.data.datasets.lerobot import write_lerobot
from vssm_gym.data.datasets.minari import check_id, load_minari, write_minari
from vssm_gym.errors import InputError, one_of
from vssm_gym.files.output_folders import check_new_folder, whole_folder

SCRATCH = ".scratch"  # the folder of what is removed at the end
Source = Callable[[Path], tuple[Description, Iterable[Episode]]]
Write = Callable[[Description, Iterable[Episode], Path, str], tuple[int, int]]

FORMATS: dict[str, tuple[Write, Callable[[object], object], Callable[[Path], None] | None]] = {
    "minari": (write_minari, load_minari, check_id),
    "lerobot": (write_lerobot, load_arrow, None),
}
"""How a data set of each format is written, what imports its library, and what checks the name of its folder."""


def check_export(source: object, form: str, out: Path) -> None:
    """Raise :class:`InputError` unless a data set can be written; it costs nothing before the episodes are driven."""
    if form not in FORMATS:
        raise InputError(source, "format", one_of(FORMATS, form))
    check_new_folder(out)
    _, load, check_name = FORMATS[form]
    if check_name is not None:
        check_name(out)
    load(source)


def write_dataset(form: str, source: Source, out: Path) -> tuple[int, int]:
    """Write a data set to a new or empty folder, which appears when it is complete.

    Args:
        form: a name of :data:`FORMATS`.
        source: returns the description and the episodes, read once and one after the other; it is called with a folder
            for what it needs in between, which is removed at the end.
        out: the folder.

    Returns:
        The number of episodes and of steps.

    Raises:
        InputError: the library of the format is not installed, the folder is not empty or has a name that the format
            does not take, or episodes differ in kind.
        OutputError: the folder cannot be written.
    """
    check_export("dataset", form, out)
    write = FORMATS[form][0]
    with whole_folder(out) as unfinished:
        scratch = unfinished / SCRATCH
        scratch.mkdir()
        description, episodes = source(scratch)
        counts = write(description, episodes, unfinished, out.resolve().name)
        shutil.rmtree(scratch)
    return counts
