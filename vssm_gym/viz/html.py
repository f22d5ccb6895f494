"""Lay out pages that need no other file: their style, and tables."""

from collections.abc import Sequence
from html import escape

STYLE = """
body{font:15px/1.45 system-ui,sans-serif;color:#1d2126;max-width:1380px;margin:24px auto;padding:0 20px}
h1{font-size:26px;margin:0 0 4px}h2{margin:34px 0 8px;font-size:20px;border-bottom:1px solid #d5d9de}
table{border-collapse:collapse;font-size:13px;margin:8px 0}th,td{padding:3px 9px;text-align:left;white-space:nowrap}
th{border-bottom:2px solid #9aa3ad;font-weight:600}tr:nth-child(even) td{background:#f4f6f8}
.n{text-align:right;font-variant-numeric:tabular-nums}.wide{overflow-x:auto}
.beside{display:flex;flex-wrap:wrap;gap:0 32px}
.runs{display:grid;grid-template-columns:repeat(auto-fill,minmax(280px,1fr));gap:12px}
figure{margin:0;border:1px solid #d5d9de;border-radius:6px;padding:6px}figure img{width:100%}
figcaption{font-size:12.5px}.bad{color:#a3203a;font-weight:600}.good{color:#0b6e4f;font-weight:600}
p.note{color:#56606b;font-size:13px;max-width:80ch}img{max-width:100%}code{background:#f0f2f4;padding:0 4px}
"""


def html_table(header: Sequence[str], lines: Sequence[Sequence[str]], numbers_from: int) -> str:
    """Return a table whose columns from ``numbers_from`` on are right-aligned; cells are escaped here."""
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = "".join(
        "<tr>"
        + "".join(f"<td{' class=n' if i >= numbers_from else ''}>{escape(cell)}</td>" for i, cell in enumerate(line))
        + "</tr>"
        for line in lines
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
