"""Put generated text where a page asks for it by a comment: ``<!-- site: NAME ARGUMENTS -->``.

A code host shows nothing in its place, and the page says what it would be. Explicit anchors, ``<a id="m1"></a>``,
become targets that links of other pages are checked against.
"""

import re
from collections.abc import Callable
from pathlib import Path

from contents import contents
from environments import environment
from reference import environment_bases, environment_classes, imported, reference
from results import results
from sphinx.application import Sphinx
from stand_ins import install

MARK = re.compile(r"^<!-- site: (\w+)(.*?)-->$", re.MULTILINE | re.DOTALL)
ANCHOR = re.compile(r'<a id="([\w-]+)"></a>')
GENERATORS: dict[str, Callable[..., str]] = {
    "contents": contents,
    "environment": environment,
    "environment_bases": environment_bases,
    "environment_classes": environment_classes,
    "imported": imported,
    "reference": reference,
    "results": results,
}


def generate(text: str) -> str:
    """Replace the comments of a page by what they name."""
    return MARK.sub(lambda mark: GENERATORS[mark.group(1)](*mark.group(2).split()), text)


def read(app: Sphinx, name: str, source: list[str]) -> None:
    """Complete the source of one page."""
    source[0] = ANCHOR.sub(r"[]{#\1}", generate(source[0]))


def open_readme(app: Sphinx, error: Exception | None) -> None:
    """Write ``index.html``, which opens the README."""
    refresh = '<meta http-equiv="refresh" content="0; url=README.html">'
    (Path(app.outdir) / "index.html").write_text(f'<!doctype html>{refresh}<a href="README.html">vssm-gym</a>\n')


def setup(app: Sphinx) -> dict[str, bool]:
    """Complete every page as it is read."""
    install()
    app.connect("source-read", read)
    app.connect("build-finished", open_readme)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
