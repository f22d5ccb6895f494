"""Pages: templates alone make markup, and what they print is escaped, visible and of limited length."""

import ast
import base64
import hashlib
import json
import re
import xml.etree.ElementTree as ET

import jinja2
import pytest
from matplotlib.figure import Figure

from tests.helpers.paths import CHECKOUT
from tests.viz.hostile_text import LONG, MARKUP, OTHER, Structure
from vssm_gym.viz import html, pictures

FOLDER = CHECKOUT / "vssm_gym" / "viz" / "templates"
TEMPLATES = sorted(FOLDER.glob("*.html.j2"))
MODULES = [path for folder in ("vssm_gym", "agents", "eval") for path in (CHECKOUT / folder).rglob("*.py")]
FOREIGN = {"html", "jinja2", "markupsafe"}
TAG = re.compile(r"</?(a|br|code|details|div|figcaption|figure|h[1-6]|head|html|i|img|li|p|pre|script|span|style|"
                 r"summary|table|t[dhr]|thead|tbody|title|ul)(\s[^<>]*)?/?>")  # fmt: skip


@pytest.fixture
def printed():
    """Return what a template of one line prints, with the environment of all pages."""
    return lambda source, **values: html._environment().from_string(source).render(values)


@pytest.mark.parametrize("text", [*MARKUP, *OTHER, LONG])
@pytest.mark.parametrize(
    "source",
    [
        "<p>{{ x }}</p>",
        '<p class="{{ x }}"></p>',
        "<p>{{ x | prose }}</p>",
        "<pre>{{ x | setting }}</pre>",
        "<pre>{{ {x: [x, {x: x}]} | setting }}</pre>",
        '<p title="{{ "of " ~ x }}"></p>',
        '{% from "macros.html.j2" import listed %}<p class="{{ listed([x, x]) }}">{{ listed([x, x]) }}</p>',
        '{% from "macros.html.j2" import facts %}{{ facts({x: [x]}) }}',
        '{% from "macros.html.j2" import marks %}<p>{{ marks([(x, "good"), (x, "")]) }}</p>',
        '{% from "macros.html.j2" import table %}'
        '{{ table({"header": [x, x], "lines": [[x, x], [x, x]], "numbers_from": 1, "sentences": [x]}) }}',
    ],
)
def test_a_text_is_no_markup_wherever_it_is_printed(printed, source, text):
    shown, like = printed(source, x=text), printed(source, x="harmless")
    names = [element if isinstance(element, str) else (element[0], [a for a, _ in element[1]])
             for element in Structure(shown).elements]  # fmt: skip
    assert names == [element if isinstance(element, str) else (element[0], [a for a, _ in element[1]])
                     for element in Structure(like).elements]  # fmt: skip
    assert "n" * 201 not in shown
    assert all(character.isprintable() or character == "\n" for character in shown)


def test_a_name_is_shown_whole_and_its_setting_can_be_read_again(printed):
    name = "<b>\"oak\" & 'elm'</b>"
    assert Structure(printed("<p>{{ x }}</p>", x=name)).text == name
    assert json.loads(Structure(printed("<pre>{{ x | setting }}</pre>", x={"a": [name]})).text) == {"a": [name]}
    long = "a sentence of the program. " * 40
    assert Structure(printed("<p>{{ x | prose }}</p>", x=long)).text == long
    assert len(Structure(printed("<p>{{ x | prose }}</p>", x=50 * long)).text) == html.LONGEST_PROSE


def test_a_value_that_is_missing_is_an_error(printed):
    for source in ("{{ x }}", "{{ {}.x }}", "{% if x %}{% endif %}", "{% for y in x %}{% endfor %}"):
        with pytest.raises(jinja2.UndefinedError):
            printed(source)


def test_a_picture_is_the_only_link(printed):
    picture = html.svg_image(b'<svg onload="alert(1)"/>')
    shown = printed('{% from "macros.html.j2" import image %}{{ image(x, y) }}', x=picture, y=MARKUP[1])
    [(tag, attributes)] = Structure(shown).elements
    assert (tag, attributes) == ("img", [("src", "data:image/svg+xml;"), ("alt", "")])


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.name)
def test_templates_neither_trust_a_text_nor_hold_a_script(path):
    text = path.read_text().replace("<script>{{ surface_script.text }}</script>", "")  # its digest is in the policy
    assert not re.search(
        r"\|\s*safe\b|autoescape|<script|\bon\w+=|href=(?!\"#[a-z]+\")|javascript:|<iframe|<object|<embed|<link", text
    )
    assert re.findall(r"\bsrc=\S*", text) in (
        [],
        [
            'src="{{',
        ],
    )  # of the macro `image`
    printed_attributes = re.findall(r"=\s*\{\{", text)
    assert not printed_attributes, "a printed attribute has quotes"


def test_pages_forbid_scripts_and_loads_themselves():
    """Should an escape ever be missing, a browser still runs nothing and asks no server."""
    policy = re.search(r'Content-Security-Policy" content="([^"{]*)', (FOLDER / "base.html.j2").read_text())
    assert policy is not None
    rules = dict(rule.strip().split(" ", 1) for rule in policy[1].split(";"))
    assert rules == {"default-src": "'none'", "img-src": "data:", "style-src": "'unsafe-inline'"}


def test_a_script_is_allowed_by_its_digest_alone_and_asks_nothing():
    """The digest in the policy is that of the element's text; the script loads nothing and makes no markup."""
    page = html._environment().from_string('{% extends "slam.html.j2" %}{% block body %}{% endblock %}')
    script = html.script("surface.js")
    shown = page.render(surface=True, surface_script=script, sequence="x")
    digest = base64.b64encode(hashlib.sha256((FOLDER / "surface.js").read_bytes()).digest()).decode()
    assert f"style-src 'unsafe-inline'; script-src 'sha256-{digest}'\">" in shown
    without = page.render(surface=None, surface_script=script, sequence="x")
    assert "script-src" not in without
    assert script.text == (FOLDER / "surface.js").read_text()
    assert "</" not in script.text and "<!--" not in script.text  # nothing that ends the element
    for call in (
        "innerHTML",
        "document.write",
        "eval",
        "Function(",
        "fetch",
        "XMLHttpRequest",
        "import",
        "://",
        "open(",
    ):
        assert call not in script.text, call
    assert len(script.text) < 12_000
    assert {path.suffix for path in FOLDER.iterdir()} == {".j2", ".css", ".js"}
    assert [path.name for path in FOLDER.glob("*.js")] == ["surface.js"]
    style = (FOLDER / "page.css").read_text()
    assert "url(" not in style and "@import" not in style and "</" not in style


def markup_in(source: str) -> list[str]:
    """Return the HTML in the strings of a module, and its use of what marks text as markup."""
    found: list[str] = []
    if not TAG.search(source) and not any(name in source for name in FOREIGN):
        return found  # nearly all modules, without parsing them
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and (tag := TAG.search(node.value)):
            found.append(f"{node.lineno}: {tag[0]}")
        elif isinstance(node, ast.ImportFrom | ast.Import):
            names = [getattr(node, "module", None) or "", *(alias.name for alias in node.names)]
            if {name.split(".")[0] for name in names} & FOREIGN and not names[0].startswith("vssm_gym"):
                found.append(f"{node.lineno}: {' '.join(names)}")
    return found


def test_html_is_made_by_templates_alone():
    found = {str(path.relative_to(CHECKOUT)): lines for path in MODULES if (lines := markup_in(path.read_text()))}
    assert list(found) == ["vssm_gym/viz/html.py"]
    assert not [line for line in found["vssm_gym/viz/html.py"] if "<" in line]


@pytest.mark.parametrize(
    "source",
    ["x = f'<p>{y}</p>'", "x = '<td class=n>' + y", "from html import escape", "from markupsafe import Markup",
     "import jinja2", "x = '<br>'.join(y)"],
)  # fmt: skip
def test_markup_in_a_module_is_found(source):
    assert markup_in(source)


@pytest.mark.parametrize("text", [*MARKUP, *OTHER, LONG, "$", "_hidden", "one\ntwo"])
def test_a_figure_shows_any_name(text):
    """Neither is a name a formula, nor does it end the SVG's comment or make it unreadable."""
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    axes.plot([1.0, 10.0], [0.0, 1.0], label=text)
    axes.set(title=text, xlabel=text, xscale="log")
    axes.set_yticks([0.0, 1.0], [pictures.tick_name(text), "b"])
    figure.suptitle(text)
    figure.legend(loc="outside lower center")
    drawn = ET.fromstring(pictures.svg(figure))
    tags = {element.tag.rpartition("}")[2] for element in drawn.iter()}
    assert not tags & {"script", "a", "image", "img", "foreignObject"}
    assert not [name for element in drawn.iter() for name in element.attrib if name.startswith("on")]


def test_numbers_of_a_logarithmic_axis_stay_powers():
    figure = Figure()
    axes = figure.subplots()
    axes.plot([1.0, 1e4], [0.0, 1.0])
    axes.set(xscale="log", title="$x$")
    pictures.take_literally(figure)
    figure.canvas.draw()
    assert axes.get_xticklabels()[2].get_parse_math()
    assert not axes.title.get_parse_math()


def test_the_study_of_calibration_shows_sequences_of_any_name():
    """Their names stand at ticks and in the table."""
    from tests.eval.studies.test_table import a_row
    from vssm_gym.eval.studies.calibration.table import study_of

    names = ["$\\frac$ \x1b[1m<b>-->", "$x$"]
    ET.fromstring(study_of({name: a_row() for name in names}, {}, ()).picture)
