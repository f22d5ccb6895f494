"""Render the HTML pages of the project, each one file that needs no other: templates, escaping, tables and pictures.

Every page is a template of ``templates/`` and the plain values that it names. Whatever a template prints is made
visible, shortened and escaped here, so that no name, wherever it comes from, becomes markup. Few things are printed
as they are: what the filters ``prose`` and ``setting`` return, :attr:`Image.url`, and the text and digest of a
:class:`Script`; all are made in this module. A page with a script names its digest in its policy, so that a browser
runs this script and no other.
"""

import base64
import hashlib
import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from vssm_gym.viz.text import LONGEST, shortened, visible

MOST_NUMBERS = 9  # columns of numbers with intervals that fit beside names
LONGEST_PROSE = 2000  # characters of a paragraph that was written in the program, with names in it
_LONG_WORD = re.compile(rf"\S{{{LONGEST + 1},}}")


@dataclass(frozen=True)
class Table:
    """Hold the cells of a table; columns from ``numbers_from`` on are right-aligned.

    A number with an interval is one cell, ``mean [low, high]``. Cells under the headings ``sentences`` may be wrapped.
    """

    header: Sequence[str]
    lines: Sequence[Sequence[str]]
    numbers_from: int
    sentences: Sequence[str] = ()

    @property
    def parts(self) -> "Sequence[Table]":
        """Cut the columns of numbers into tables that fit a page, each with all columns of names."""
        names, numbers = self.numbers_from, len(self.header) - self.numbers_from
        size = max(1, math.ceil(numbers / max(1, math.ceil(numbers / MOST_NUMBERS))))
        cuts = [slice(first, first + size) for first in range(names, max(len(self.header), names + 1), size)]
        of = lambda cells, cut: [*cells[:names], *cells[cut]]
        return [replace(self, header=of(self.header, c), lines=[of(line, c) for line in self.lines]) for c in cuts]


@dataclass(frozen=True)
class Tile:
    """Hold one number of a page's summary; ``kind`` is ``main``, ``good``, ``warn``, ``bad``, or empty."""

    label: str
    value: str
    note: str
    kind: str = ""
    is_word: bool = False  # twice as wide: a name is longer than a number


@dataclass(frozen=True)
class Image:
    """Hold an encoded picture that this program drew. It may not be one that was read from a file."""

    content: bytes
    kind: Literal["image/svg+xml", "image/webp"]

    @property
    def url(self) -> Markup:
        """The picture as a ``data:`` URL, the only kind of link in a page. Base64 holds no character to escape."""
        return Markup(f"data:{self.kind};base64,{base64.b64encode(self.content).decode('ascii')}")


def svg_image(content: bytes) -> Image:
    """Return the :class:`Image` of a figure that matplotlib wrote as SVG."""
    return Image(content, "image/svg+xml")


def webp_image(content: bytes) -> Image:
    """Return the :class:`Image` of a figure that was encoded as WebP."""
    return Image(content, "image/webp")


@dataclass(frozen=True)
class Script:
    """Hold a script of ``templates/``; it is printed as it is, and holds no value of a page."""

    text: Markup

    @property
    def digest(self) -> Markup:
        """Return the source expression of a content security policy that allows this script alone."""
        digest = hashlib.sha256(self.text.encode()).digest()
        return Markup(f"'sha256-{base64.b64encode(digest).decode('ascii')}'")


def script(name: str) -> Script:
    """Return the script ``name`` of ``templates/``."""
    loader = _environment().loader
    assert loader is not None
    return Script(Markup(loader.get_source(_environment(), name)[0]))


@dataclass(frozen=True)
class Data:
    """Hold data that a script of the page reads."""

    content: bytes

    @property
    def url(self) -> Markup:
        """The data as a ``data:`` URL. Base64 holds no character to escape."""
        return Markup(f"data:application/octet-stream;base64,{base64.b64encode(self.content).decode('ascii')}")


def render(template: str, /, **values: Any) -> str:
    """Fill in a template of ``templates/``.

    Args:
        template: the file's name.
        values: the names that it uses.

    Raises:
        jinja2.UndefinedError: it uses a name that ``values`` lacks.
    """
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("vssm_gym.viz"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        auto_reload=False,
    )
    environment.filters |= {"prose": _prose, "setting": _setting}
    return environment


def _shown(value: Any) -> Any:
    """Prepare what a template prints, before it is escaped; markup of a macro, a block or a filter is complete."""
    return value if isinstance(value, Markup) else shortened(visible(str(value)))


def _prose(text: str) -> Markup:
    """Return a text of the program, which may be longer than a name; the names in it are shortened."""
    whole = _LONG_WORD.sub(lambda word: shortened(word[0]), visible(text))
    return escape(shortened(whole, LONGEST_PROSE))


def _setting(value: Any) -> Markup:
    """Return a configuration as indented JSON, for preformatted text."""
    return escape(json.dumps(_with_short_names(value), indent=1))


def _with_short_names(value: Any) -> Any:
    if isinstance(value, str):
        return shortened(value)
    if isinstance(value, dict):
        return {shortened(str(name)): _with_short_names(inner) for name, inner in value.items()}
    return [_with_short_names(inner) for inner in value] if isinstance(value, list | tuple) else value
