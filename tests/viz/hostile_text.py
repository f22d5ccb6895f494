"""Put markup, formulas and control characters into every text of rows and settings, and compare pages by structure."""

import re
import types
from collections.abc import Callable, Mapping
from html.parser import HTMLParser
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel

from vssm_gym.eval.episodes.row import EpisodeRow

LONG = "n" * 5000
MARKUP = (
    "<script>alert(1)</script>",
    '"><img src=x onerror=alert(1)>',
    "' onmouseover='alert(1)",
    "</script></style></title></pre>--><!--",
    "{{7*7}}{% raw %}",
    "&lt;b&gt;&#60;i>",
)
OTHER = (
    r"$\frac$",
    r"\$x",
    "[bold red]loud[/bold red][/]",
    ":smile:",
    "\x00\x07\x1b[31m\x1b]0;title\x07\x9b2J",
    "\r\n\t",
    "\u202etxt.exe\u2066\u200b",
    "javascript:alert(1)",
    "../../etc/passwd",
)
KINDS = {"markup": "".join(MARKUP), "other": "".join(OTHER), "long": LONG}
"""Texts for a whole page, each short enough to be shown whole, but for the last."""

Change = Callable[[str], str]


def suffix(text: str) -> Change:
    """Return the change that puts ``text`` after a text: what begins with a baseline's prefix still does."""
    return lambda value: value + text


def harmless(value: str) -> str:
    """Change a text as an attack does, so that known names are as unknown as there."""
    return f"{value}-harmless"


def changed(value: Any, change: Change) -> Any:
    """Return plain data with every text in it changed; the keys of a mapping are names of fields and stay."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, Mapping):
        return {name: changed(inner, change) for name, inner in value.items()}
    return [changed(inner, change) for inner in value] if isinstance(value, list | tuple) else value


def changed_row(row: dict[str, Any], change: Change, keep: frozenset[str] = frozenset()) -> dict[str, Any]:
    """Return a row with every text field of the schema changed, also those that it lacks; ``keep`` stay as they are.

    A failure of None means success and stays. A field of a new type fails here until it is thought of.
    """
    return _changed_model(row, EpisodeRow, change, keep)


def _changed_model(
    values: dict[str, Any], model: type[BaseModel], change: Change, keep: frozenset[str] = frozenset()
) -> dict[str, Any]:
    result = dict(values)
    for name, field in model.model_fields.items():
        value = values.get(name)
        if name in keep or (name == "failure" and value is None):
            continue
        [kind] = [inner for inner in _options(field.annotation) if inner is not types.NoneType]
        if kind is str:
            result[name] = change(name if value is None else value)
        elif value is not None:
            result[name] = _changed_value(value, kind, change)
    return result


def _changed_value(value: Any, kind: Any, change: Change) -> Any:
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return _changed_value(value, inner[0], change)
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return _changed_model(value, kind, change)
    if kind in (int, float, bool) or origin is Literal:
        return value
    if origin is list:
        return [_changed_value(one, inner[0], change) for one in value]
    if origin is dict and inner[0] is str:
        held = {name: _changed_value(one, inner[1], change) for name, one in value.items()}
        return held | {change("more"): one for one in list(held.values())[:1]}
    if origin is types.UnionType or kind is str:
        return changed(value, change)
    raise AssertionError(f"a field of type {kind}: say here how its texts are changed")


def _options(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)


class Structure(HTMLParser):
    """Read a page: its elements with their attributes in ``elements``, what a reader sees in ``text``.

    The texts of ``alt`` are no part of ``elements``, and the content of pictures is not either.
    """

    def __init__(self, page: str) -> None:
        super().__init__()
        self.elements: list[Any] = []
        self.text = ""
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note an element."""
        self.elements.append((tag, [(name, self._value(name, value or "")) for name, value in attrs]))

    @staticmethod
    def _value(name: str, value: str) -> str:
        return "" if name == "alt" else value.partition("base64,")[0]

    def handle_endtag(self, tag: str) -> None:
        """Note the end of an element."""
        self.elements.append(f"/{tag}")

    def handle_comment(self, data: str) -> None:
        """Note a comment, of which pages have none."""
        self.elements.append(("comment", data))

    handle_decl = handle_pi = unknown_decl = handle_comment

    def handle_data(self, data: str) -> None:
        """Collect the text."""
        self.text += data


ELEMENTS = {
    *("html", "head", "meta", "title", "style", "body", "h1", "h2", "h3", "p", "div", "span", "b", "i", "br"),
    *("table", "thead", "tbody", "tr", "th", "td", "figure", "figcaption", "img", "ul", "li"),
    *("code", "pre", "details", "summary", "nav", "a", "small", "svg", "rect"),
}
"""The elements that pages are made of."""


def check_page(page: str, like: str) -> Structure:
    """Check that a page has the elements and attributes of ``like``, no script, no outer link, no long name."""
    found, expected = Structure(page), Structure(like)
    assert found.elements == expected.elements
    elements = [element for element in found.elements if isinstance(element, tuple) and element[0] != "comment"]
    assert {tag for tag, _ in elements} <= ELEMENTS
    links = [value for _, attributes in elements for name, value in attributes if name in ("src", "href", "srcset")]
    assert all(link.startswith("data:image/") or re.fullmatch("#[a-z]+", link) for link in links)
    assert {name for _, attributes in elements for name, _ in attributes} <= {
        *("lang", "charset", "http-equiv", "content", "name", "class", "src", "alt", "href", "id"),
        *("viewbox", "preserveaspectratio", "aria-hidden", "x", "y", "width", "height"),
    }
    assert "n" * 201 not in page
    assert all(character.isprintable() or character == "\n" for character in page)
    return found
