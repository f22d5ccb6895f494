"""Read how scenes are named: a built-in name, a seed, a file, or a line of a file of houses."""

from pathlib import Path

from vssm_gym.envs.scenes.generator import PREFIX

LINES = (".jsonl", ".jsonl.gz")  # endings of files with a house on each line


def house_line(spec: str) -> tuple[Path, int] | None:
    """Return file and line, counted from 0, of ``houses.jsonl.gz#7``; None for any other scene."""
    name, _, number = spec.rpartition("#")
    if not name.endswith(LINES) or not (number.isascii() and number.isdigit()):
        return None
    return Path(name), int(number[:9])


def scene_file(spec: str) -> Path:
    """Return the file of a scene that is neither built in nor of a seed."""
    found = house_line(spec)
    return Path(spec) if found is None else found[0]


def scene_name(spec: str) -> str:
    """Return a scene's name in rows and files: a built-in name, a seed or a line with dashes, or a file's stem."""
    if spec.startswith(PREFIX):
        return spec.replace(":", "-")
    if (found := house_line(spec)) is None:
        return Path(spec).stem
    path, line = found
    return f"{path.name.removesuffix('.gz').removesuffix('.jsonl')}-{line}"


def spec_of_name(name: str) -> str:
    """Return how a scene is asked for whose name in rows is given: the inverse of :func:`scene_name` without a file."""
    return name.replace("-", ":", 2) if name.startswith(PREFIX.replace(":", "-")) else name
