"""Test that a report of a damaged sweep is refused in one line."""

import json
from pathlib import Path

import pytest

from vssm_gym.errors import InputError
from vssm_gym.eval.report.page import write_report

BASELINE = Path(__file__).resolve().parents[3] / "eval" / "baselines" / "car"


@pytest.fixture
def sweep(tmp_path):
    """Return a folder with two episodes of a committed sweep, and its manifest."""
    rows = (BASELINE / "episodes.jsonl").read_text().splitlines()[:2]
    (tmp_path / "episodes.jsonl").write_text("\n".join(rows) + "\n")
    return tmp_path, json.loads((BASELINE / "sweep.json").read_text())


@pytest.mark.parametrize("field", ["voxel", "agents", "noise", "scenes", "seeds", "env"])
@pytest.mark.parametrize("value", [None, "x", {}])
def test_a_configuration_that_lacks_what_the_page_shows(sweep, field, value):
    folder, manifest = sweep
    manifest["config"][field] = value
    (folder / "sweep.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=f"config.{field}"):
        write_report(folder)


def test_a_row_of_another_sweep(sweep):
    folder, manifest = sweep
    manifest["config"]["agents"] = ["someone"]
    (folder / "sweep.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"agent: expected a value of config\.agents"):
        write_report(folder)
