"""Hold the pages to the code: paths, labels of equations, citations, links, Python and commands all lead somewhere."""

import ast
import functools
import importlib
import inspect
import re
import shlex
from pathlib import Path

import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.cli.main import COMMANDS, build_app

PAGES = sorted([CHECKOUT / "README.md", CHECKOUT / "CONTRIBUTING.md", *CHECKOUT.glob("docs/**/*.md")])
SCIENCE = [CHECKOUT / "docs/science" / f"{name}.md" for name in ("model", "inference", "planning", "tasks")]
CODE = sorted(
    path
    for folder in ("vssm_gym", "agents", "eval", "envs", "tests")
    for path in (CHECKOUT / folder).rglob("*")
    if path.suffix in {".py", ".yaml", ".md", ".toml"} and not any(part.is_symlink() for part in path.parents)
)
# The folders that dotted names in the pages start with: `envs.` stands for `vssm_gym.envs.`. Not `model.`: pages also
# call a model of stable-baselines3 so.
LAYERS = sorted(
    {path.name for path in (CHECKOUT / "vssm_gym").iterdir() if (path / "__init__.py").is_file()} - {"model"}
)
PLACEHOLDER = re.compile(r"^[A-Z]+(?:\.|$)|NAME|\*|\{|<")
# Private documents that a reader does not have. The path helper of the tests names the folder of recordings.
PRIVATE = re.compile(
    r"\bSPEC(?:\.md| \d|'s)|\bDESIGN\b|\bMEASURED\b|\bSTYLE(?:\.md| \d)|(?<![\w/])shared/(?:data|hooks)|\.\./shared\b"
    r"|(?i:\bissue #?\d)"
)
KEEPS_THE_PATH = {"tests/helpers/paths.py", "tests/test_docs.py"}
LABEL = r"[MIPT]\d+"
CITED = re.compile(rf"\b[Ee]qs?\.\s+({LABEL}(?:(?:,| and| to|, and)\s+{LABEL})*)")


def ids(path: Path) -> str:
    """Return a file's path from the checkout: names of parametrised tests and messages."""
    return str(path.relative_to(CHECKOUT))


def text_of(page: Path) -> str:
    """Return a page without its fenced blocks."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def spans(page: Path) -> list[str]:
    """List what stands in backticks outside of fenced blocks."""
    return re.findall(r"`([^`\n]+)`", text_of(page))


@functools.cache
def resolves(name: str) -> bool:
    """Return whether a dotted name leads to a module, or to what one defines, imports or annotates."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith("vssm_gym"):
                return defined(name)  # an optional dependency is missing here
            continue
        for part in parts[length:]:
            if not hasattr(found, part):
                return part in inspect.get_annotations(found) if inspect.isclass(found) else False
            found = getattr(found, part)
        return True
    return False


def defined(name: str) -> bool:
    """Return whether a module's text defines a dotted name; nothing is imported."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        folder = CHECKOUT.joinpath(*parts[:length])
        path = folder.with_suffix(".py") if folder.with_suffix(".py").is_file() else folder / "__init__.py"
        if path.is_file():
            body: list[ast.stmt] = ast.parse(path.read_text()).body
            for part in parts[length:]:
                found = [node for node in body if part in names_of(node)]
                if not found:
                    return False
                body = getattr(found[0], "body", [])
            return True
    return False


def names_of(node: ast.stmt) -> set[str]:
    """Return the names that a statement defines."""
    if isinstance(node, ast.ClassDef | ast.FunctionDef):
        return {node.name}
    targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
    return {target.id for target in targets if isinstance(target, ast.Name)}


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_dotted_names_resolve(page):
    names = {span for span in spans(page) if re.fullmatch(r"[a-z]\w*(\.\w+)+", span)}
    ours = {f"vssm_gym.{name}": name for name in names if name.partition(".")[0] in LAYERS}
    ours |= {name: name for name in names if name.startswith("vssm_gym.")}
    files = re.compile(r"\.(py|md|yaml|json|html|txt|npz|toml|ply|svg|jsonl|mp4|png|csv)$")
    missing = [name for full, name in ours.items() if not files.search(full) and not resolves(full)]
    assert sorted(missing) == []


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_files_in_backticks_exist(page):
    paths = {span for span in spans(page) if re.fullmatch(r"[\w.-]+(/[\w.-]+)+\.(py|md|yaml|toml|xml)", span)}
    paths |= set(re.findall(r"(?<![\w/])tests/[\w/]+\.py", page.read_text()))  # in commands too
    paths -= set(re.findall(r"Save it as `([^`]+)`", page.read_text()))  # an example that the reader writes
    roots = (CHECKOUT, CHECKOUT / "vssm_gym", page.parent)
    missing = [
        path
        for path in paths
        if not any(PLACEHOLDER.search(part) for part in path.split("/"))
        and not any((root / path).exists() for root in roots)
    ]
    assert sorted(missing) == []


@functools.cache
def labels() -> list[str]:
    """List the labels of all equations in the order of the pages."""
    return [
        label
        for page in SCIENCE
        for label in re.findall(rf'^<a id="\w+"></a>\*\*({LABEL})\*\*', page.read_text(), re.M)
    ]


@pytest.mark.parametrize(("page", "letter"), list(zip(SCIENCE, "MIPT", strict=True)), ids="MIPT")
def test_equations_are_numbered_and_name_their_functions(page, letter):
    """Each label has an anchor of its name, an equation, and a function that computes it."""
    entries = re.split(r"^(?=<a id=)", page.read_text(), flags=re.MULTILINE)[1:]
    for number, entry in enumerate(entries, start=1):
        anchor, label = re.match(rf'<a id="(\w+)"></a>\*\*({LABEL})\*\*', entry).groups()
        assert (anchor, label) == (f"{letter}{number}".lower(), f"{letter}{number}")
        assert re.search(r"\n\n {4}\S.*\n\n", entry, re.DOTALL), f"{label} has no equation"
        assert re.search(r"^`vssm_gym\.[\w.]+`", entry, re.MULTILINE), f"{label} names no function"


@pytest.mark.parametrize("folder", ["vssm_gym", "agents", "eval", "envs", "tests", "docs"])
def test_cited_equations_exist(folder):
    known = set(labels())
    paths = PAGES if folder == "docs" else [path for path in CODE if ids(path).startswith(f"{folder}/")]
    unknown = [
        f"{ids(path)}: {label}"
        for path in paths
        for cited in CITED.findall(path.read_text())
        for label in re.findall(LABEL, cited)
        if label not in known
    ]
    assert unknown == []


def folder_of(path: Path) -> str:
    """Return the folder that a file is counted under: two levels of the library, one of all else."""
    parts = path.relative_to(CHECKOUT).parts
    return "/".join(parts[: 2 if parts[0] == "vssm_gym" else 1]) if len(parts) > 1 else "."


CITING = {path: folder_of(path) for path in [*CODE, *PAGES, CHECKOUT / "Makefile", CHECKOUT / "pyproject.toml"]}


# Folders where private documents are still cited; each goes when its folder is done.
STILL_OPEN = {"agents", "eval", "tests", "vssm_gym/cli", "vssm_gym/envs", "vssm_gym/training"}


@pytest.mark.parametrize("folder", sorted(set(CITING.values()) - STILL_OPEN))
def test_nothing_private_is_cited(folder):
    found = [
        f"{ids(path)}:{number}: {match.group()}"
        for path, where in CITING.items()
        if where == folder and ids(path) not in KEEPS_THE_PATH
        for number, line in enumerate(path.read_text().splitlines(), start=1)
        for match in PRIVATE.finditer(line)
    ]
    assert found == []


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page: its headings as GitHub spells them, and explicit ones."""
    found, text = set(re.findall(r'<a id="([\w-]+)">', page.read_text())), text_of(page)
    for heading in re.findall(r"^#+ +(.+?) *$", text, flags=re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        slug = re.sub(r"[^\w\- ]", "", plain.lower()).replace(" ", "-")
        number = 0
        while (name := slug if not number else f"{slug}-{number}") in found:
            number += 1
        found.add(name)
    return found


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\((?!https?://|mailto:)([^)\s]+)", text_of(page)):
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), f"{ids(page)} links to {target}"
        if anchor:
            assert anchor in anchors(linked), f"{ids(page)} links to {target}, which has no such heading"


def test_the_index_names_every_page():
    folder = CHECKOUT / "docs"
    index = (folder / "index.md").read_text()
    missing = [ids(page) for page in folder.glob("**/*.md") if f"({page.relative_to(folder)})" not in index]
    assert sorted(set(missing) - {"docs/index.md"}) == []


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_python_of_the_pages_compiles_and_its_imports_resolve(page):
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL):
        tree = ast.parse(block)
        compile(tree, ids(page), "exec")
        names = [
            f"{node.module}.{alias.name}"
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "vssm_gym"
            for alias in node.names
        ]
        names += [a.name for node in ast.walk(tree) if isinstance(node, ast.Import) for a in node.names]
        assert [name for name in names if name.startswith("vssm_gym") and not resolves(name)] == []


def commands(page: Path) -> list[str]:
    """List the command lines of a page: in fences, continuation lines joined, and in backticks."""
    fences = re.findall(r"^```(\w*)\n(.*?)^```", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    fenced = [block for language, block in fences if language in {"", "bash", "sh", "console"}]
    lines = re.findall(r"^(?:\S*/)?(vssm-gym .*(?:\n +\S.*)*)", "\n".join(fenced), flags=re.MULTILINE)
    return lines + [span for span in spans(page) if span.startswith("vssm-gym ")]


@functools.cache
def options(name: tuple[str, ...]) -> frozenset[str]:
    """Return the options of a command, read from its help."""
    import contextlib
    import io

    target = functools.reduce(lambda tree, part: tree[part], name, COMMANDS)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pytest.raises(SystemExit):
        build_app({"command": target, "other": target}).cli(prog="vssm-gym", args=["command", "--help"])
    return frozenset(re.findall(r"--[a-z][\w-]*", printed.getvalue()))


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_commands_of_the_pages_are_those_of_the_command_line(page):
    for line in commands(page):
        words = shlex.split(line.replace("[--", " --").replace("]", " "), comments=True)[1:]
        if PLACEHOLDER.search(words[0]) or words[0].startswith("--"):
            continue
        name, tree = [], COMMANDS
        while isinstance(tree, dict) and len(name) < len(words):
            word = words[len(name)].split("|")[0]
            if PLACEHOLDER.search(word):
                break
            assert word in tree, f"{ids(page)}: {line}"
            name, tree = [*name, word], tree[word]
        if isinstance(tree, str):
            known = options(tuple(name)) | {"--help"}
            files = [word for word in words if word.startswith(("eval/", "envs/", "agents/", "tests/"))]
            assert [file for file in files if not (CHECKOUT / file).exists()] == []
            unknown = {word.partition("=")[0] for word in words if word.startswith("--")} - known
            assert not unknown, f"{ids(page)}: {line}: {unknown}"
