"""List the pages of the site in its side bar: the sections of ``docs/index.md``, and the pages that each links."""

import re
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]


def contents() -> str:
    """Return a hidden toctree for each section of the index that is a table of pages."""
    found, trees = {"docs/index"}, [tree("", ["docs/index"])]
    for section in re.split(r"^## ", (CHECKOUT / "docs/index.md").read_text(), flags=re.MULTILINE)[1:]:
        caption, _, text = section.partition("\n")
        linked = re.findall(r"^\| \[[^]]*\]\(([^)#]+)\.md\) \|", text, flags=re.MULTILINE)
        pages = [str((CHECKOUT / "docs" / page).resolve().relative_to(CHECKOUT)) for page in linked]
        if new := [page for page in pages if page not in found]:
            trees.append(tree(caption, new))
            found.update(new)
    return "\n".join(trees)


def tree(caption: str, pages: list[str]) -> str:
    """Return one toctree."""
    title = f":caption: {caption}\n" if caption else ""
    return f"```{{toctree}}\n:hidden:\n{title}\n" + "\n".join(pages) + "\n```\n"
