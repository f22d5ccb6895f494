"""Test ``vssm-gym reproduce``: equal outcomes pass, an altered row is named, and what cannot be run is refused."""

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.cli.sweeps.reproduce import reproduce
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE
from vssm_gym.eval.reproduction.comparison import NOT_OUTCOMES, first_difference
from vssm_gym.eval.sweep.config import SweepConfig
from vssm_gym.eval.sweep.runner import run_sweep

CONFIG = SweepConfig(
    env=("vssm_gym/LidarMaze-v0",),
    scenes=("pillars-v1",),
    agents=("dist_bug",),
    robot=("disc",),
    physics=("none",),
    noise=("none", "low"),
    tasks=(0, 7, 9),
)


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sweep") / "out"
    run_sweep(CONFIG, folder, workers=1)
    return folder


def altered(folder, tmp_path, **change):
    """Return a copy of a sweep's folder whose last row has other values."""
    copy = tmp_path / "altered"
    copy.mkdir()
    (copy / "sweep.json").write_text((folder / "sweep.json").read_text())
    rows = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    rows[-1] |= change
    (copy / FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    return copy


def test_rows_have_the_same_outcome_once_more(sweep, tmp_path, capsys):
    reproduce(sweep, tmp_path / "again", episodes=4, workers=1)
    assert "4 of 4 rows have the same outcome" in capsys.readouterr().out
    again = (tmp_path / "again" / FILE).read_text().splitlines()
    assert len(again) == 4


def test_an_altered_row_fails_and_the_field_is_named(sweep, tmp_path, capsys):
    length = json.loads((sweep / FILE).read_text().splitlines()[-1])["path_length"]
    with pytest.raises(SystemExit):
        reproduce(altered(sweep, tmp_path, path_length=length + 0.01), tmp_path / "again", workers=1)
    said = capsys.readouterr().out
    assert "pillars-v1, dist_bug, noise low, task 9: path_length: expected" in said
    assert "5 of 6 rows have the same outcome" in said


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"agent": "policy@12345678"}, "config.agents: expected agents of the registry"),
        ({"agent": "astar"}, "agents"),
    ],
)
def test_what_cannot_be_run_is_refused(sweep, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        reproduce(altered(sweep, tmp_path, **change), tmp_path / "again", workers=1)
    with pytest.raises(InputError, match="sweep"):
        reproduce(tmp_path / "nothing", tmp_path / "other")


def test_a_scene_that_has_changed_is_refused(sweep, tmp_path):
    copy = altered(sweep, tmp_path)
    manifest = json.loads((copy / "sweep.json").read_text())
    manifest["scene_hashes"]["pillars-v1"] = "0" * 16
    (copy / "sweep.json").write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"scene_hashes\.pillars-v1"):
        reproduce(copy, tmp_path / "again", workers=1)


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-5, 5) | st.floats(-5.0, 5.0) | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=2), inner, max_size=3),
    max_leaves=8,
)


@given(row=st.dictionaries(st.text(max_size=4), VALUES, max_size=5), later=VALUES)
def test_a_row_agrees_with_itself_and_with_fields_that_came_later(row, later):
    assert first_difference(row, row, 0.0) is None
    assert first_difference(row, {"came_later": later} | row, 0.0) is None


@given(value=st.floats(-10.0, 10.0), off=st.floats(0.0, 0.1))
def test_numbers_agree_within_the_tolerance(value, off):
    found = first_difference({"outer": [{"inner": value}]}, {"outer": [{"inner": value + off}]}, 0.01)
    allowed = 0.01 * max(1.0, abs(value), abs(value + off))
    if not math.isclose(off, allowed, abs_tol=1e-9):
        assert (found is None) == (off < allowed)
    assert found is None or found.startswith("outer[0].inner: expected")


def test_kinds_that_differ_never_agree():
    assert first_difference({"success": True}, {"success": 1}, 0.5) == "success: expected True, now 1"
    assert first_difference({"status": "arrived"}, {}, 0.5) == "status: expected 'arrived'; now it is not there"
    assert first_difference({"goal": [1.0]}, {"goal": [1.0, 2.0]}, 0.5) is not None
    assert first_difference(dict.fromkeys(NOT_OUTCOMES, 1), dict.fromkeys(NOT_OUTCOMES, 2), 0.0) is None
