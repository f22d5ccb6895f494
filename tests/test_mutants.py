"""Test the catalogue of ``make mutants`` against the source, and its runner on a package of one function."""

import ast
from collections import Counter
from pathlib import Path

import pytest

from tests.helpers.paths import CHECKOUT
from tests.mutants.__main__ import check, exit_code
from tests.mutants.catalogue import MUTANTS
from tests.mutants.mutant import Mutant, StaleMutantError

PACKAGE = "def double(x):\n    return x + x\n"
TESTS = "import vssm_gym\n\n\ndef test_double():\n    assert vssm_gym.double(2) == 4\n"


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a checkout with one function, a test that passes and one that fails; beside it lies a namesake."""
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # plugins take longer to load than these tests
    files = {
        "checkout/vssm_gym/__init__.py": PACKAGE,
        "checkout/tests/test_double.py": TESTS,
        "checkout/tests/test_triple.py": TESTS.replace("4", "6"),
        "other/vssm_gym/__init__.py": PACKAGE,
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path / "checkout"


def of_double(name: str, after: str, tests: str = "tests/test_double.py") -> Mutant:
    return Mutant(name, "vssm_gym/__init__.py", "return x + x", after, (tests,))


def test_only_a_failing_test_counts(tiny, capsys) -> None:
    """An equivalent change is missed.

    There is no verdict on a text that is gone, on code that does not compile, on tests of another package of the same
    name, and on tests that fail without the error.
    """
    elsewhere = f"import sys; sys.path.insert(0, {str(tiny.parent / 'other')!r}); import vssm_gym\n"
    expected = {
        of_double("triple", "return x + x + x"): "caught",
        of_double("equivalent", "return 2 * x"): "missed",
        of_double("no-syntax", "return x +"): "broken",
        of_double("no-baseline", "return 0", "tests/test_triple.py"): "broken",
        Mutant("gone", "vssm_gym/__init__.py", "return 3 * x", "return x", ("tests/test_double.py",)): "stale",
        Mutant("foreign", "tests/test_double.py", "import vssm_gym\n", elsewhere, ("tests/test_double.py",)): "broken",
    }
    assert check(list(expected), tiny, 2) == 1
    lines = capsys.readouterr().out.splitlines()
    found = {m.name: next(line.split()[0] for line in lines if f" {m.name}" in line) for m in expected}
    assert found == {m.name: verdict for m, verdict in expected.items()}
    assert (tiny / "vssm_gym/__init__.py").read_text() == PACKAGE


@pytest.mark.parametrize(
    ("counts", "code"),
    [
        ({"caught": 9, "missed": 1, "passes": 3}, 0),
        ({"caught": 8, "missed": 2, "passes": 3}, 1),
        ({"caught": 9, "stale": 1}, 1),
        ({"caught": 9, "broken": 1}, 1),
    ],
)
def test_nine_of_ten_must_be_caught_and_all_must_have_a_verdict(counts: dict[str, int], code: int) -> None:
    assert exit_code(Counter(counts)) == code


@pytest.mark.parametrize("before", ["double", "x", "triple"])
def test_a_text_that_occurs_not_exactly_once_is_stale(before: str, tiny) -> None:
    mutant = Mutant("renamed", "vssm_gym/__init__.py", before, "y", ("tests/test_double.py",))
    if before == "double":
        assert mutant.mutated(tiny) == PACKAGE.replace("double", "y")
    else:
        with pytest.raises(StaleMutantError, match="renamed"):
            mutant.mutated(tiny)


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_every_mutant_applies_and_has_its_tests(mutant: Mutant) -> None:
    """A change of the source that a mutant names moves the mutant too; the result is still Python."""
    ast.parse(mutant.mutated(CHECKOUT))
    for test in mutant.tests:
        file, _, name = test.partition("::")
        assert f"def {name}(" in (CHECKOUT / file).read_text() or not name, test


def test_names_are_unique() -> None:
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 24
