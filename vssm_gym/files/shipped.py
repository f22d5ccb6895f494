"""Find the maps and policies that come with the package: their names stand for files, wherever a path is asked for."""

from pathlib import Path

ASSETS = Path(__file__).parents[1] / "envs" / "assets"
MAPS, POLICIES = "maps", "policies"  # folders of ASSETS


def names(folder: str) -> list[str]:
    """Return the names of all files of a folder of assets."""
    return sorted(path.stem for path in (ASSETS / folder).glob("*.npz"))


def shipped(path: str | Path, folder: str) -> Path:
    """Return the file of a name of ``folder``; any other path, and that of a file that is there, as it is."""
    path = Path(path)
    named = len(path.parts) == 1 and not path.suffix and not path.exists()
    return ASSETS / folder / f"{path}.npz" if named and path.name in names(folder) else path


def beside(path: str | Path, parent: Path, folder: str) -> Path:
    """Return a relative path taken from ``parent``, or the file of a name of ``folder``."""
    taken = parent / path
    return taken if taken.exists() or str(path) not in names(folder) else shipped(path, folder)


def or_shipped(folder: str) -> str:
    """Return the end of a message that says what a path may be."""
    return f", or one that comes with the package: {', '.join(names(folder))}"
