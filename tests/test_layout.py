"""Test the layout of the checkout: small folders, first lines, annotated functions, tests that mirror the package."""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
FOLDERS = ("vssm_gym", "agents", "eval", "tests")  # the links inside vssm_gym lead to the other two
MODULES = 20  # the most that a reader keeps in mind of one folder
PACKAGE = ("vssm_gym", "agents", "eval")
RIDDLE = re.compile(r"(Whether|What|How|Of|Where)\b")

# Folders of tests for what has no folder of its own in the package.
TESTS_ONLY = {"helpers"}


def python_files(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (CHECKOUT / folder).rglob("*.py"))


def docstrings(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield ``(name, first line)`` of every docstring of a module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield getattr(node, "name", "module"), text.splitlines()[0]


def riddles(tree: ast.Module) -> list[str]:
    return [f"{name}: {line}" for name, line in docstrings(tree) if RIDDLE.match(line)]


def is_kernel(function: ast.FunctionDef) -> bool:
    """Return true for a function that numba compiles: it takes its types from the call."""
    return any("njit" in ast.unparse(decorator) for decorator in function.decorator_list)


def bare(tree: ast.Module) -> list[str]:
    """Return the functions and methods without all annotations; kernels and functions inside functions are exempt."""
    found, scopes = [], [tree]
    while scopes:
        for node in scopes.pop().body:
            if isinstance(node, ast.ClassDef):
                scopes.append(node)
            elif isinstance(node, ast.FunctionDef) and not is_kernel(node):
                a = node.args
                arguments = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, [a.vararg, a.kwarg])]
                named = [x for x in arguments if x.arg not in ("self", "cls")]
                if any(x.annotation is None for x in named) or (node.returns is None and node.name != "__init__"):
                    found.append(f"{node.lineno}: {node.name}")
    return found


def numbers(tree: ast.Module) -> Iterator[tuple[str, ast.Assign | ast.AnnAssign]]:
    """Yield every ``(CAPITAL, assignment)`` of a module whose value is written with numbers and without strings."""
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            values = [part.value for part in ast.walk(node.value) if isinstance(part, ast.Constant)]
            if values and all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
                yield from ((name, node) for name in names if name.isupper())


def unexplained(source: str) -> list[str]:
    """Return the capitals that are numbers and have no comment on their lines or the line above."""
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    alone = {token.start[0]: token.line.lstrip().startswith("#") for token in tokens if token.type == tokenize.COMMENT}
    return [
        f"{node.lineno}: {name}"
        for name, node in numbers(ast.parse(source))
        if not alone.get(node.lineno - 1) and not alone.keys() & range(node.lineno, (node.end_lineno or 0) + 1)
    ]


def ambiguous(sources: dict[str, str]) -> dict[str, list[str]]:
    """Return ``name -> modules`` of the capitals that several modules define as numbers."""
    modules = defaultdict(set)
    for module, source in sources.items():
        for name, _ in numbers(ast.parse(source)):
            modules[name].add(module)
    return {name: sorted(found) for name, found in modules.items() if len(found) > 1}


def test_no_folder_is_crowded():
    for folder in {path.parent for path in python_files(*FOLDERS)}:
        modules = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(modules) <= MODULES, f"{folder.relative_to(CHECKOUT)}: {len(modules)} modules"


@pytest.mark.parametrize("folder", FOLDERS)
def test_first_lines_are_sentences_or_equations(folder):
    found = [
        f"{path.relative_to(CHECKOUT)} {line}"
        for path in python_files(folder)
        for line in riddles(ast.parse(path.read_text()))
    ]
    assert found == []


@pytest.mark.parametrize("folder", PACKAGE)
def test_functions_are_annotated(folder):
    found = {
        str(path.relative_to(CHECKOUT)): names
        for path in python_files(folder)
        if (names := bare(ast.parse(path.read_text())))
    }
    assert found == {}


def test_a_number_has_one_name_and_one_home():
    """A reader who meets MARGIN knows which one it is; a number that two modules need is imported."""
    assert ambiguous({str(path.relative_to(CHECKOUT)): path.read_text() for path in python_files(*PACKAGE)}) == {}


def test_numbers_are_explained():
    found = {str(path.relative_to(CHECKOUT)): unexplained(path.read_text()) for path in python_files(*PACKAGE)}
    assert {path: names for path, names in found.items() if names} == {}


def test_folders_of_tests_mirror_the_package():
    package = CHECKOUT / "vssm_gym"
    for path in (CHECKOUT / "tests").rglob("test_*.py"):
        folder = path.parent.relative_to(CHECKOUT / "tests")
        assert (package / folder).is_dir() or str(folder) in TESTS_ONLY, f"{path.name}: no vssm_gym/{folder}"


@pytest.mark.parametrize(
    ("check", "source"),
    [
        (riddles, 'def f():\n    """Whether so much of it is."""'),
        (riddles, 'class A:\n    """A."""\n\n    def f(self):\n        """How far, m."""'),
        (riddles, '"""What a robot does."""'),
        (bare, "def f(a) -> int: ..."),
        (bare, "class A:\n    def f(self, a: int): ..."),
        (bare, "def f(a: int, *rest, **more: int) -> int: ..."),
    ],
)
def test_each_check_finds_its_fault(check, source):
    assert len(check(ast.parse(source))) == 1


@pytest.mark.parametrize(
    ("check", "source"),
    [
        (riddles, 'def f():\n    """Offer the clearance."""'),
        (bare, "@numba.njit(cache=True)\ndef f(a, b): ..."),
        (bare, "class A:\n    def __init__(self, a: int):\n        def g(carry): ...\n"),
    ],
)
def test_correct_code_passes(check, source):
    assert check(ast.parse(source)) == []


BARE = ["A = 1", "# m\n\nA = 1", "B = 2  # m\nA = 1", "A: float = -1.0", "A = math.radians(3.0)", "A = (1, 2 * B)"]
FINE = [
    "# m\nA = 1",
    "A, B = 1, (2, 3)  # m",
    "A = (\n    1,  # m\n    2,\n)",
    "A = 'x', 1",
    "A = True",
    "A = B",
    "a = 1",
]


@pytest.mark.parametrize("source", BARE)
def test_a_bare_number_is_found(source):
    assert len(unexplained(source)) == 1


@pytest.mark.parametrize("source", FINE)
def test_what_needs_no_comment_passes(source):
    assert unexplained(source) == []


def test_two_homes_of_a_name_are_found():
    sources = {"a.py": "A, B = 1, 2", "b.py": "A = 2 * C", "c.py": "B = 'x'\nfrom a import A"}
    assert ambiguous(sources) == {"A": ["a.py", "b.py"]}
