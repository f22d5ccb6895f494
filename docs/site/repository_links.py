"""Show the files of the repository that pages link: their text as a page ``source/PATH.html``, a folder as a list."""

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

from docutils import nodes
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import TextLexer, get_lexer_for_filename
from pygments.util import ClassNotFound
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.transforms import SphinxTransform
from sphinx.util.osutil import relative_uri

SHOWN = 200_000  # characters: a longer file is cut


def linked(env: BuildEnvironment) -> set[str]:
    """Return the paths that pages link, from the checkout."""
    if not hasattr(env, "repository_links"):
        env.repository_links = set()  # type: ignore[attr-defined]
    return env.repository_links  # type: ignore[attr-defined]


class FileLinks(SphinxTransform):
    """Turn a link to a file or folder that is no page into one to the page that shows it."""

    default_priority = 5  # before Sphinx copies what is linked as a download

    def apply(self, **kwargs: Any) -> None:
        """Turn the links of one page."""
        root = Path(self.env.srcdir)
        for node in list(
            self.document.findall(lambda n: isinstance(n, addnodes.download_reference | addnodes.pending_xref))
        ):
            if node.get("reftype") != "myst" or node.get("refdomain"):
                continue
            path = (root / self.env.docname).parent.joinpath(node["reftarget"]).resolve()
            if not path.exists() or not path.is_relative_to(root):
                continue
            name = str(path.relative_to(root))
            linked(self.env).add(name)
            uri = relative_uri(f"{self.env.docname}.html", f"source/{name}.html")
            node.replace_self(nodes.reference("", "", *node.children, refuri=uri, internal=True))


def shown(path: Path) -> str:
    """Return the HTML of a file's text, or of the list of a folder."""
    if path.is_dir():
        items = "".join(f"<li><code>{escape(entry.name)}</code></li>" for entry in sorted(path.iterdir()))
        return f"<ul>{items}</ul>"
    text = path.read_text()[:SHOWN]
    try:
        lexer = get_lexer_for_filename(path.name)
    except ClassNotFound:
        lexer = TextLexer()
    return highlight(text, lexer, HtmlFormatter(cssclass="highlight"))


def pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield a page for every file that is linked."""
    for name in sorted(linked(app.env)):
        body = f"<h1>{escape(name)}</h1>{shown(Path(app.srcdir) / name)}"
        yield f"source/{name}", {"title": name, "body": body}, "page.html"


def setup(app: Sphinx) -> dict[str, bool]:
    """Turn links as pages are read; write what they lead to in the end."""
    app.add_transform(FileLinks)
    app.connect("html-collect-pages", pages)
    return {"parallel_read_safe": False, "parallel_write_safe": True}
