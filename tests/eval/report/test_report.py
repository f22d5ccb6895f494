"""Test the report on synthetic rows: failures first, every number from the rows, one complete file."""

import json
import re
import shutil
from html.parser import HTMLParser

import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.errors import InputError
from vssm_gym.eval.episodes.manifest import read_manifest
from vssm_gym.eval.metrics import aggregate
from vssm_gym.eval.metrics.registry import measured
from vssm_gym.eval.report import figures, tables
from vssm_gym.eval.report.page import write_report
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.viz import pictures

BASELINES = sorted(path.parent for path in (CHECKOUT / "eval" / "baselines").glob("*/episodes.jsonl"))
CONFIG = {
    "env": ["vssm_gym/PointNav-v0"],
    "scenes": ["oak"],
    "agents": ["astar", "dead_reckoning", "random"],
    "robot": ["holonomic"],
    "noise": ["low"],
    "sensor_noise": ["none"],
    "renderer": ["raycast"],
    "physics": ["mujoco"],
    "tasks": list(range(20)),
    "seeds": [0],
    "voxel": 0.05,
}


def episode(agent, task, success, failure=None):
    """Return the row of a run along y = 0.1 task whose estimate drifts sideways."""
    true = np.stack([np.linspace(0.0, 2.0 + 0.1 * task, 12), np.full(12, 0.1 * task)], axis=-1)
    drift = np.linspace(0.0, 0.02 if agent == "astar" else 0.6, 12)
    keeps_estimate = agent != "random"
    return {
        "env": "vssm_gym/PointNav-v0",
        "scene": "oak",
        "scene_hash": "abc",
        "robot": "holonomic",
        "noise": "low",
        "sensor_noise": "none",
        "renderer": "raycast",
        "physics": "mujoco",
        "end_on": "stop",
        "task": task,
        "seed": 0,
        "agent": agent,
        "version": "0.1.0",
        "success": success,
        "spl": 0.9 * success,
        "soft_spl": 0.8,
        "path_length": 2.5,
        "geodesic": 2.0 + 0.1 * task,
        "steps": 40,
        "collisions": 0 if success else 3,
        "distance_to_goal": 0.1 if success else 1.5,
        "location_error_mean": float(drift.mean()) if keeps_estimate else None,
        "location_error_max": float(drift.max()) if keeps_estimate else None,
        "location_error_final": float(drift[-1]) if keeps_estimate else None,
        "nees": 1.25 + 0.5 * task if keeps_estimate else None,
        "in_95": 0.75 if keeps_estimate else None,
        "latency": {"tracking": {"p50": 0.004, "p95": 0.012}} if keeps_estimate else {},
        "failure": failure,
        "goal": [2.0 + 0.1 * task, 0.1 * task],
        "success_radius": 0.4,
        "trace": {
            "true": true.round(3).tolist(),
            "estimate": (true + drift[:, None] * [0, 1]).round(3).tolist() if keeps_estimate else None,
            "contacts": [] if success else [[1.0, 0.1 * task]],
        },
    }


def box_map():
    """Return a 3 x 2 x 1.6 m map: a wall at x = 2.5 m, a red table 0.6 m high, and nothing observed at x > 2.8."""
    voxel_map = VoxelMap.prior(np.array([0.0, -0.5, -0.2]), 0.1, (32, 24, 24))
    x, y, z = np.meshgrid(
        *(low + 0.1 * np.arange(n) for low, n in zip((0, -0.5, -0.2), voxel_map.shape, strict=True)), indexing="ij"
    )
    wall, table = abs(x - 2.5) - 0.15, np.maximum(np.maximum(abs(x - 1.0) - 0.3, abs(y - 0.5) - 0.3), z - 0.6)
    occupancy = -np.minimum(np.minimum(wall, table), z)
    colour = np.where((table < 0.1)[..., None], [1.0, 0.0, 0.0], 0.5)
    precision = np.where(x > 2.8, 0.01, 4.0)
    return VoxelMap(
        occupancy=voxel_map.blocked(jnp.asarray(occupancy, jnp.float32)),
        occupancy_precision=voxel_map.blocked(jnp.asarray(precision, jnp.float32)),
        colour=voxel_map.blocked(jnp.asarray(colour, jnp.float32)),
        colour_precision=voxel_map.blocked(jnp.asarray(precision, jnp.float32)),
        empty=voxel_map.empty,
        origin=voxel_map.origin,
        voxel_size=voxel_map.voxel_size,
        blocks=voxel_map.blocks,
    )


@pytest.fixture(scope="module")
def reported(tmp_path_factory):
    """A sweep's folder with its report, to be read only."""
    folder = tmp_path_factory.mktemp("reported") / "sweep"
    folder.mkdir()
    rows = [episode("astar", t, t != 7, "lost track: 1.30 m off at the end" if t == 7 else None) for t in range(20)]
    rows += [episode("dead_reckoning", t, t % 2 == 0, None if t % 2 == 0 else "stopped outside") for t in range(20)]
    rows += [episode("random", t, False, "time out") for t in range(20)]
    manifest = {"config": CONFIG, "config_hash": "0123456789abcdef", "version": "0.1.0", "seed": 0, "episodes": 60}
    (folder / "sweep.json").write_text(json.dumps(manifest))
    (folder / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "maps").mkdir()
    box_map().save(folder / "maps" / "oak.npz")
    assert write_report(folder) == folder / "report.html"
    return folder


@pytest.fixture
def sweep_folder(reported, tmp_path):
    """A copy of it that a test may change."""
    shutil.copytree(reported, tmp_path / "sweep")
    return tmp_path / "sweep"


class Page(HTMLParser):
    """Collect headings and link targets, and check that tags balance."""

    def __init__(self, text):
        super().__init__()
        self.open, self.links, self.headings, self.text = [], [], [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.links += [value for name, value in attributes if name in ("src", "href")]
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data + "\n"
        if self.open and self.open[-1] in ("h1", "h2"):
            self.headings.append(data)


def test_the_report_is_one_page_with_failures_first(reported):
    path = reported / "report.html"
    text = path.read_text()
    page = Page(text)
    assert page.open == []
    assert page.headings[1] == "Failures"
    assert all(link.startswith(("data:", "#")) for link in page.links)
    assert not re.search(r"(?:https?:)?//[a-z]", re.sub(r"data:[^'\"]*", "", text))
    assert path.stat().st_size < 5e6
    assert not list(reported.glob(".*.tmp"))
    # The rarest failure is drawn first, with its reason.
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    assert captions[0].startswith("astar · oak · low · task 7")
    assert "lost track: 1.30 m off at the end" in captions[0]
    assert captions.index(next(c for c in captions if "success" in c)) > captions.index(
        [c for c in captions if 'class="bad"' in c][-1]
    )
    for fact in ("0123456789abcdef", "0.1.0", "raycast", "60 of 60", "astar - dead_reckoning"):
        assert fact in page.text
    lead = " ".join(re.sub("<[^>]*>", "", text[text.index('class="lead"') :].partition("</p>")[0]).split())
    spl, other = np.mean([0.9] * 19 + [0.0]), 0.45
    assert f"astar has the highest SPL of 2 agents, {spl:.2f} [" in lead
    assert f"before dead_reckoning with {other:.2f} [" in lead
    assert f"(paired difference of SPL {spl - other:.3f} [" in lead and lead.endswith("]: a difference).")
    assert "has not ended" not in text


def test_the_same_rows_give_the_same_page_in_any_order(sweep_folder):
    first = (sweep_folder / "report.html").read_bytes()
    log = sweep_folder / "episodes.jsonl"
    log.write_text("".join(line + "\n" for line in reversed(log.read_text().splitlines())))
    assert write_report(sweep_folder).read_bytes() == first


def test_the_page_states_that_a_sweep_is_unfinished(sweep_folder):
    log = sweep_folder / "episodes.jsonl"
    log.write_text("".join(line + "\n" for line in log.read_text().splitlines()[:30]))
    assert "30 of 60" in (text := write_report(sweep_folder).read_text())
    assert "has not ended" in text


@pytest.mark.parametrize(("file", "content"), [("sweep.json", "{}"), ("sweep.json", "["), ("episodes.jsonl", "")])
def test_a_folder_without_results_is_refused_and_the_old_report_kept(sweep_folder, file, content):
    before = (sweep_folder / "report.html").read_bytes()
    (sweep_folder / file).write_text(content)
    with pytest.raises(InputError, match=file):
        write_report(sweep_folder)
    assert (sweep_folder / "report.html").read_bytes() == before


def test_a_folder_that_is_no_sweep_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"sweep\.json: file: expected a sweep's folder; `vssm-gym sweep"):
        write_report(tmp_path)
    for track in ("navigation", "car"):
        (tmp_path / track).mkdir()
        (tmp_path / track / "sweep.json").touch()
    with pytest.raises(
        InputError, match=rf"a sweep's folder; those of {re.escape(str(tmp_path))} are car, navigation$"
    ):
        write_report(tmp_path)  # of a benchmark


def test_rare_failures_are_drawn_first():
    rows = [episode("random", t, False, "time out") for t in range(20)]
    rows += [episode("astar", t, t > 1, None if t > 1 else "lost track") for t in range(20)]
    chosen = figures.choose_failures(rows, limit=5, each=4)
    assert [row["agent"] for row in chosen] == ["astar", "astar", "random", "random", "random"]
    longest = figures.choose_successes(rows, limit=1)
    assert longest[0]["task"] == 19


def test_the_table_counts_failures_by_kind():
    rows = [episode("astar", 0, False, "lost track: 1 m"), episode("astar", 1, False, "lost track: 2 m")]
    table = tables.failure_counts([*rows, episode("astar", 2, True)])
    assert table.header[-2:] == ["failed", "lost track"]
    assert table.lines == [["oak", "astar", "2 of 3", "2"]]


def test_the_calibration_of_estimates_stands_in_the_tables_with_the_interval_of_other_metrics(reported):
    rows = [measured(episode(agent, t, True)) for agent in ("astar", "random") for t in range(20)]
    table = tables.results(rows, 0, metrics=("location_error_mean", "nees", "in_95"), by=("agent",))
    assert table.header[-3:] == ["location error m", "NEES / dim", "inside 95 %"]
    interval = aggregate.mean(rows[:20], "nees", 0)
    assert interval.low < 1.25 + 0.5 * 9.5 == interval.mean < interval.high
    kept, without = table.lines
    assert kept[-3:] == ["0.010 [0.010, 0.010]", interval.text(2), "0.75 [0.75, 0.75]"]
    assert without[-3:] == ["-", "-", "-"]
    page = " ".join(Page((reported / "report.html").read_text()).text.split())
    assert "NEES / dim : squared error of the agent" in page
    assert interval.text(2) in page


def test_rows_from_before_a_field_have_a_dash_and_alone_no_column():
    new, old = ([measured(episode(agent, t, True)) for t in range(3)] for agent in ("astar", "dead_reckoning"))
    for row in old:
        del row["nees"], row["in_95"]
    table = tables.results([*new, *old], 0)
    places = [table.header.index(label) for label in ("NEES / dim", "inside 95 %")]
    assert [line[place] == "-" for line in table.lines for place in places] == [False, False, True, True]
    assert not {"NEES / dim", "inside 95 %"} & set(tables.results(old, 0).header)


def test_responses_are_means_over_the_episodes_that_count_them():
    counts = {"astar": [{"backs off": 2}, {}, {"backs off": 1, "turns around": 3}], "dead_reckoning": [None] * 3}
    rows = [
        {**measured(episode(agent, t, True)), "responses": found}
        for agent, of in counts.items()
        for t, found in enumerate(of)
    ]
    table = tables.responses(rows)
    assert table is not None
    assert table.header == ["agent", "episodes", "backs off", "turns around"]
    assert table.lines == [["astar", "3", "1.000", "1.000"], ["dead_reckoning", "3", "-", "-"]]
    assert tables.responses(rows[3:]) is None


def test_the_map_from_above_shows_walls_dark_tables_in_colour_and_the_unknown_grey():
    picture = pictures.topdown(box_map(), cut_height=1.0, resolution=0.05)
    low_x, high_x, low_y, high_y = picture.extent
    assert (low_x, low_y) == pytest.approx((0.0, -0.5))
    assert high_x == pytest.approx(3.1, abs=0.06)

    def at(x, y):
        row = int((y - low_y) / (high_y - low_y) * picture.image.shape[0])
        return picture.image[row, int((x - low_x) / (high_x - low_x) * picture.image.shape[1])]

    np.testing.assert_allclose(at(2.5, 0.5), pictures.CUT_COLOUR)
    np.testing.assert_allclose(at(3.0, 0.5), pictures.UNKNOWN_COLOUR)
    np.testing.assert_allclose(at(1.0, 0.5), [1.0, 0.35, 0.35], atol=1e-3)
    np.testing.assert_allclose(at(1.8, 1.2), 0.675, atol=1e-3)  # the grey floor


@pytest.mark.slow
@pytest.mark.parametrize("folder", BASELINES, ids=lambda path: path.name)
def test_committed_rows_have_a_report(folder, tmp_path):
    """The committed rows have no traces, latencies and maps; the page leaves these out."""
    before = sorted(path.name for path in folder.iterdir())
    path = write_report(folder, out=tmp_path / "page.html")
    assert path == tmp_path / "page.html"
    assert sorted(path.name for path in folder.iterdir()) == before
    page = Page(path.read_text())
    assert page.open == []
    assert "Results" in page.headings
    assert not {"Successful runs", "Latency of a step", "Cost-to-go"} & set(page.headings)
    manifest = read_manifest(folder / "sweep.json")
    assert manifest["config_hash"] in page.text
    assert all(agent in page.text for agent in manifest["config"]["agents"])
    assert "nan" not in page.text.lower().split()


@pytest.mark.slow
def test_a_report_is_written_to_the_given_path_or_not_at_all(sweep_folder, tmp_path):
    before = (sweep_folder / "report.html").read_bytes()
    (sweep_folder / "report.html").unlink()
    with pytest.raises(InputError, match="folder: expected a folder that exists"):
        write_report(sweep_folder, out=sweep_folder / "none" / "page.html")
    elsewhere = tmp_path / "page.html"
    write_report(sweep_folder, out=elsewhere)
    assert not (sweep_folder / "report.html").exists()
    assert elsewhere.read_bytes() == before
