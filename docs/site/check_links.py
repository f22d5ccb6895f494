"""Check the built site: every link and anchor leads somewhere, and nothing is loaded from elsewhere.

    python docs/site/check_links.py site

Addresses of the web that a reader may follow are not opened.
"""

import re
import sys
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADED = {  # attributes whose files a browser loads by itself
    "audio": ("src",),
    "embed": ("src",),
    "iframe": ("src",),
    "img": ("src", "srcset"),
    "link": ("href",),
    "object": ("data",),
    "script": ("src",),
    "source": ("src", "srcset"),
    "track": ("src",),
    "video": ("src", "poster"),
}
STYLE_URL = re.compile(r"url\(\s*['\"]?([^'\")]+)|@import\s+['\"]([^'\"]+)")


class Page(HTMLParser):
    """Collect the anchors of a page, what it links and what it loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Read one tag."""
        found = {name: value for name, value in attrs if value is not None}
        self.anchors |= {found[name] for name in ("id", "name") if name in found}
        if tag == "a" and "href" in found:
            self.links.append(found["href"])
        for name in LOADED.get(tag, ()):
            if name == "srcset":
                self.loaded += [one.split()[0] for one in found.get(name, "").split(",") if one.strip()]
            elif name in found:
                self.loaded.append(found[name])
        self.loaded += urls_of_style(found.get("style", ""))


def urls_of_style(text: str) -> list[str]:
    """Return what a style sheet loads."""
    return [one or other for one, other in STYLE_URL.findall(text)]


def elsewhere(url: str) -> bool:
    """Return whether an address is of the web: with a scheme, or one that takes the page's."""
    parts = urlsplit(url)
    return parts.scheme not in ("", "data") or bool(parts.netloc)


@cache
def parsed(path: Path) -> Page:
    """Read a page once."""
    return Page(path.read_text(encoding="utf-8"))


def faults(site: Path) -> Iterator[str]:
    """Yield one line for each link that leads nowhere, and for each file that is loaded from the web."""
    for path in sorted(site.rglob("*.css")):
        loaded = urls_of_style(path.read_text(encoding="utf-8"))
        yield from (f"{path.relative_to(site)} loads {url}" for url in loaded if elsewhere(url))
    for path in sorted(site.rglob("*.html")):
        page, name = parsed(path), path.relative_to(site)
        yield from (f"{name} loads {url}" for url in page.loaded if elsewhere(url))
        for url in [*page.links, *page.loaded]:
            parts = urlsplit(url)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                yield f"{name} links {url}, which is no file"
            elif parts.fragment and target.suffix == ".html" and unquote(parts.fragment) not in parsed(target).anchors:
                yield f"{name} links {url}, which has no such anchor"


if __name__ == "__main__":
    site = Path(sys.argv[1])
    found = list(faults(site))
    print("\n".join(found) or f"{len(list(site.rglob('*.html')))} pages: every link leads somewhere")
    sys.exit(bool(found) or not (site / "index.html").is_file())
