"""Test ``vssm-gym doctor``: what it finds on a machine, and how it says what is missing."""

import importlib.metadata
import re
import tomllib

import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.cli import doctor as doctor_module
from vssm_gym.cli.doctor import Probe, run_probe


def test_doctor_reports_and_fails_only_for_what_is_required(vssm, monkeypatch):
    works = Probe("arithmetic", "print(1 + 1)", "")
    absent = Probe("a library", "import no_such_library_anywhere", "apt-get install [it]")
    optional = Probe("a screen", "raise OSError('no display')", "a monitor", required=False)

    monkeypatch.setattr(doctor_module, "PROBES", (works, optional))
    code, out, _ = vssm("doctor")
    assert code == 0
    assert "does not work here" in out and "no display" not in out
    assert "-> a monitor" in out

    monkeypatch.setattr(doctor_module, "PROBES", (works, absent))
    code, out, _ = vssm("doctor")
    assert code == 1
    assert "missing" in out and "is not installed" in out
    assert "-> apt-get install [it]" in out


@pytest.mark.parametrize(
    "code",
    [
        "import no_such_library_anywhere",
        "raise AttributeError(\"'NoneType' object has no attribute 'glGetError'\")",
        "import os; os.abort()",
        "import sys; sys.exit('a library says: Error 7')",
        "def f(): f()\nf()",
    ],
)
def test_doctor_shows_no_text_of_an_exception(vssm, monkeypatch, code):
    """A failure is one line in our words, and one line that says what to do."""
    monkeypatch.setattr(doctor_module, "PROBES", (Probe("a thing", code, "get it", required=False),))
    monkeypatch.setattr(doctor_module, "EXTRAS", {})
    _, out, _ = vssm("doctor")
    lines = out.splitlines()
    (i,) = (i for i, line in enumerate(lines) if "a thing" in line)
    assert re.fullmatch(r"absent +a thing +(is not installed|does not work here) *", lines[i])
    assert lines[i + 1].strip() == "-> get it"
    assert not re.search(r"Error|Traceback|Exception", out)


def test_doctor_knows_every_extra():
    """The extras are those of pyproject.toml, each with all of its packages."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]
    declared = project["optional-dependencies"]
    assert set(doctor_module.EXTRAS) == set(declared)
    name = lambda text: re.split(r"[^A-Za-z0-9_.-]", text)[0]
    for one, packages in declared.items():
        assert sorted(map(name, doctor_module.requirements(one))) == sorted(map(name, packages)), one


@pytest.mark.parametrize(("also", "state"), [("", "absent"), ("numpy", "partly")])
def test_doctor_says_how_to_get_an_absent_extra(monkeypatch, also, state):
    declared = ["numpy>=2", *(f'{name}>=1; extra == "rl"' for name in filter(None, (also, "no-such-thing")))]
    monkeypatch.setattr(doctor_module.importlib.metadata, "requires", lambda _: declared)
    finding = doctor_module.extra("rl")
    assert (finding.ok, finding.required, finding.state) == (False, False, state)
    installed = f"{also} {importlib.metadata.version(also)}; " if also else ""
    assert (finding.detail, finding.remedy) == (
        f"{installed}not installed: no-such-thing",
        "pip install -c constraints.txt no-such-thing in the checkout",
    )


def test_doctor_without_an_installed_distribution_says_so(monkeypatch):
    def absent(_: str) -> list[str]:
        raise doctor_module.importlib.metadata.PackageNotFoundError("vssm-gym")

    monkeypatch.setattr(doctor_module.importlib.metadata, "requires", absent)
    finding = doctor_module._packages()
    assert not finding.ok and finding.required and "pip install -e ." in finding.remedy


def test_a_probe_survives_a_crash_and_a_hang(monkeypatch):
    crash = run_probe(Probe("crash", "import os; os.abort()", ""))
    assert not crash.ok
    assert crash.detail == "does not work here"
    monkeypatch.setattr(doctor_module, "TIMEOUT", 0.2)
    hang = run_probe(Probe("hang", "import time; time.sleep(30)", ""))
    assert not hang.ok
    assert "no answer" in hang.detail


@pytest.mark.parametrize("probe", [p for p in doctor_module.PROBES if "OpenGL" not in p.name], ids=lambda p: p.name)
def test_the_real_probes_succeed_here(probe):
    finding = run_probe(probe)
    assert finding.ok, finding.detail
