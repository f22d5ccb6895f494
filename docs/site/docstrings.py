"""Read docstrings as they are written: prose with equations, which reStructuredText would take for markup."""

import re
from typing import Any

from sphinx.application import Sphinx

# literals, roles and references as they stand; else what would open markup: *, |, and a _ at the end of a word
MARKUP = re.compile(r"``.+?``|:[\w:]+:`[^`]+`|`[^`]+`_{0,2}|(?P<plain>[*|]|(?<=\w)_(?!\w))")
ARRAY = re.compile(r"~?jaxlib\._jax\.Array")
LIKE = re.compile(
    r"~?(jax\.)?Array \| ~?numpy\.ndarray \| ~?numpy\.bool \| ~?numpy\.number \| bool \| int \| float \| complex"
)
BLOCK = " " * 4  # what is indented so after an empty line is an equation, a table or a program


def escape(line: str) -> str:
    """Escape what is no markup in one line of a docstring."""
    return MARKUP.sub(lambda found: "\\" + found.group() if found.group("plain") else found.group(), line)


def readable(lines: list[str]) -> list[str]:
    """Return a docstring with its indented blocks as literal ones, and all else escaped."""
    found: list[str] = []
    inside = False
    for before, line in zip(["", *lines], lines, strict=False):
        if line.strip():
            begins = line.startswith(BLOCK) and not before.strip() and bool(found)
            if begins and not inside:
                found += ["::", ""]
            inside = line.startswith(BLOCK) and (inside or begins)
        found.append(line if inside else escape(line))
    return found


def process(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Make one docstring readable, in place."""
    lines[:] = readable(lines)


def sign(app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str | None, returned: str | None) -> Any:
    """Write the types of JAX as the code writes them."""
    return tuple(
        text if text is None else LIKE.sub("ArrayLike", ARRAY.sub("Array", text)) for text in (signature, returned)
    )


def setup(app: Sphinx) -> dict[str, bool]:
    """Read every docstring before its sections are found."""
    app.connect("autodoc-process-docstring", process, priority=100)
    app.connect("autodoc-process-signature", sign)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
