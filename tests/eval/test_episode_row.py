"""Test the round trip of rows, rows of earlier formats, and the committed rows."""

import json

import hypothesis.strategies as st
import pytest
from hypothesis import HealthCheck, given, settings

from tests.eval.report.test_report import episode as navigated
from tests.eval.report.test_report_car import episode as driven
from tests.helpers.explore_runs import run as explored
from tests.helpers.paths import CHECKOUT
from vssm_gym.agents.registry import AGENTS
from vssm_gym.agents.renamed import RENAMED, current_name
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.log import FILE, EpisodeLog, read_rows
from vssm_gym.eval.episodes.manifest import MANIFEST, completed, read_manifest
from vssm_gym.eval.episodes.row import FORMAT, KEY, RENAMED_FIELDS, EpisodeRow, checked

BASELINES = sorted(path.parent for path in (CHECKOUT / "eval" / "baselines").glob("*/episodes.jsonl"))
ROWS = {
    "navigation": navigated("astar", 3, True),
    "car": driven("dwa", "bullet", 1),
    "explore": explored("walk", 20.0, navigation=1.0),
}


def values(field):
    """Generate values of a field's type by its schema, including whole numbers for floats."""
    if field.annotation in (str, str | None):
        return st.text(max_size=8)
    return st.from_type(field.annotation)


rows = st.fixed_dictionaries(
    {name: values(EpisodeRow.model_fields[name]) for name in (*KEY, "scene", "success") if name not in ("task", "seed")}
    | {"task": st.integers(0, 10**6), "seed": st.integers(0, 2**32)}
    | {"failure": st.none() | st.text(max_size=8), "path_length": st.floats(0.0, 1e6)},
    optional={
        "spl": st.none() | st.floats(0.0, 1.0) | st.integers(0, 1),
        "steps": st.none() | st.integers(0, 10**6),
        "entropy": st.none() | st.floats(-1e9, 1e9),
        "latency": st.dictionaries(
            st.text(max_size=5), st.fixed_dictionaries({"p50": st.floats(0, 9), "p95": st.just(1)})
        ),
        "goal": st.lists(st.floats(-9, 9), min_size=2, max_size=3),
        "trace": st.none()
        | st.fixed_dictionaries(
            {"true": st.lists(st.lists(st.floats(-9, 9), min_size=2, max_size=2), max_size=3)},
            optional={"estimate": st.none(), "contacts": st.just([]), "reached": st.just({"50": [1.0, 2.0]})},
        ),
        "budget": st.just({"steps": 5, "seconds": 1.0}),
    },
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(row=rows)
def test_a_row_that_is_written_reads_back_equal(tmp_path, row):
    """Absent fields stay absent, and nulls stay null."""
    (tmp_path / FILE).unlink(missing_ok=True)
    with EpisodeLog(tmp_path / FILE) as log:
        log.append(row)
        assert log.rows == [{"format": FORMAT, **row}]
    assert read_rows(tmp_path / FILE) == [{"format": FORMAT, **row}]


@pytest.mark.parametrize("name", ROWS)
def test_rows_of_every_kind_fit_the_schema(name):
    assert checked(ROWS[name]) == ROWS[name]  # and rows from before the format was written do


@pytest.mark.parametrize("folder", BASELINES, ids=lambda path: path.name)
def test_committed_rows_are_complete_when_read(folder):
    """Fields that the files leave out come from ``sweep.json``; a row's own fields stand."""
    rows, manifest = read_rows(folder / FILE), read_manifest(folder / MANIFEST)
    lines = [json.loads(line) for line in (folder / FILE).read_text().splitlines()]
    assert len(rows) == len(lines) > 0
    config, hashes = manifest["config"], manifest["scene_hashes"]
    for row, line in zip(rows, lines, strict=True):
        line["agent"] = current_name(line["agent"])
        said = {RENAMED_FIELDS.get(name, name): value for name, value in (manifest["common"] | line).items()}
        assert row.items() >= said.items()
        assert row["env"] == config["env"][0]
        assert row["robot"] == config["robot"][0]
        assert row["agent"] in config["agents"]
        assert row["scene_hash"] == hashes[row["scene"]]


@pytest.mark.parametrize("agents", [None, "astar", [["astar"]], 3])
def test_a_manifest_with_damaged_agents_is_one_error(tmp_path, agents):
    manifest = {"config": {"agents": agents}, "config_hash": "", "version": "", "seed": 0, "episodes": 1}
    (tmp_path / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(InputError, match=r"config\.agents: expected a list"):
        read_manifest(tmp_path / MANIFEST)


def test_rows_of_renamed_agents_are_read_under_their_present_names(tmp_path):
    """Rows and manifest are translated as they are read; a new row of the same agent is the same episode."""
    manifest = {"config": {"agents": list(RENAMED)}, "config_hash": "", "version": "", "seed": 0, "episodes": 1}
    (tmp_path / MANIFEST).write_text(json.dumps(manifest))
    former = "".join(json.dumps(ROWS["explore"] | {"agent": name}) + "\n" for name in RENAMED)
    (tmp_path / FILE).write_text(former)
    present = list(RENAMED.values())
    assert [row["agent"] for row in read_rows(tmp_path / FILE)] == present
    assert read_manifest(tmp_path / MANIFEST)["config"]["agents"] == present
    with EpisodeLog(tmp_path / FILE) as log:
        assert [row["agent"] for row in log.rows] == present
    assert (tmp_path / FILE).read_text() == former  # the file stays as it was written
    assert set(present) <= set(AGENTS)
    assert not set(RENAMED) & set(AGENTS)


@pytest.mark.parametrize("old_format", [{"format": 1}, {}], ids=["format 1", "before formats"])
def test_renamed_fields_are_read_under_both_names_and_written_under_the_new_ones(tmp_path, old_format):
    """Rows of format 1 become rows of the present format; the earliest rows stay without a format."""
    new = ROWS["car"] | {"collided": True, "collision_events": 2}
    old = {name: value for name, value in new.items() if name not in RENAMED_FIELDS.values()} | old_format
    (tmp_path / FILE).write_text(json.dumps(old | {"touched": True, "touches": 2}) + "\n")
    assert read_rows(tmp_path / FILE) == [new | ({"format": FORMAT} if old_format else {})]
    with EpisodeLog(tmp_path / FILE) as log:
        log.append(new | {"task": 10**6})
    last = json.loads((tmp_path / FILE).read_text().splitlines()[-1])
    assert last["format"] == FORMAT and (last["collided"], last["collision_events"]) == (True, 2)
    assert not set(RENAMED_FIELDS) & last.keys()


def test_a_row_with_both_names_of_a_field_is_refused():
    with pytest.raises(ValueError, match="touched"):
        checked(ROWS["car"] | {"touched": True})


def test_a_rows_own_fields_come_before_the_shared_ones():
    manifest = {
        "config": {"env": ["a"], "noise": ["low", "mid"], "scenes": ["oak"]},
        "common": {"seed": 1, "version": "1"},
    }
    whole = completed({"version": "2"}, manifest | {"scene_hashes": {"oak": "abc"}})
    assert whole == {"env": "a", "scene": "oak", "scene_hash": "abc", "seed": 1, "version": "2"}
    assert "noise" not in whole  # two values, so it is unknown which


def test_a_row_that_cannot_be_completed_is_named(tmp_path):
    manifest = {"config": {"env": ["a"]}, "config_hash": "", "version": "", "seed": 0, "episodes": 1}
    (tmp_path / MANIFEST).write_text(json.dumps(manifest))
    (tmp_path / FILE).write_text('{"task": 1, "success": true}\n')
    with pytest.raises(InputError, match="line 1: expected one episode as JSON; scene: Field required"):
        read_rows(tmp_path / FILE)


@pytest.mark.parametrize(
    ("change", "field"),
    [({"spl": 1.5}, "spl"), ({"success": 1}, "success"), ({"steps": "9"}, "steps"), ({"trace": {"tru": []}}, "trace")],
)
def test_an_invalid_row_is_not_written(tmp_path, change, field):
    with EpisodeLog(tmp_path / FILE) as log, pytest.raises(ValueError, match=field):
        log.append(ROWS["navigation"] | change)
    assert (tmp_path / FILE).read_bytes() == b""
