"""Names of any content in every text of a sweep: the page has the elements of one with harmless names."""

import json
from dataclasses import fields, replace

import pytest

from tests.eval.report import test_report, test_report_car, test_report_explore
from tests.eval.report.test_report import box_map
from tests.helpers.explore_runs import run
from tests.helpers.straight_policy import straight
from tests.viz.hostile_text import KINDS, LONG, MARKUP, OTHER, changed, changed_row, check_page, harmless, suffix
from vssm_gym.agents.policy.policy_file import LONGEST_POLICY_NAME, PolicySpec, label, save
from vssm_gym.cli.shared.console import print_results
from vssm_gym.eval.episodes.row import EpisodeRow
from vssm_gym.eval.protocols.registry import view_of
from vssm_gym.eval.report import explore_figures, page
from vssm_gym.eval.report.page import write_report

NO_ROWS = frozenset[str]()


def pointnav_rows():
    rows = [test_report.episode("astar", t, t > 0, None if t else "lost track: 1 m") for t in range(3)]
    return rows + [test_report.episode("random", t, False, "time out") for t in range(3)]


def car_rows():
    runs = [(physics, task) for physics in ("mujoco", "bullet") for task in (0, 1)]
    rows = [test_report_car.episode("vi_mpc", *run, collisions=2 * (run == ("bullet", 1))) for run in runs]
    return rows + [test_report_car.episode("dwa", *run, success=run[1] > 0) for run in runs]


def explore_rows():
    rows = []
    for scene in ("oak", "elm"):
        for task in (0, 1):
            rows.append(run("mi_explorer", 12.0, scene=scene, task=task, collided=task == 1, navigation=1.0))
            rows.append(run("frontier_gain", 11.0 + task, scene=scene, task=task, navigation=0.5))
            rows.append(run("random_walk", 60.0, ends=40.0, stopped=False, scene=scene, task=task, navigation=0.5))
    return rows


MAZE = test_report.CONFIG | {"env": ["vssm_gym/LidarMaze-v0"]}
SWEEPS = {
    "pointnav": (test_report.CONFIG, pointnav_rows, NO_ROWS),
    "lidar_maze": (MAZE, pointnav_rows, NO_ROWS),
    "car": (test_report_car.CONFIG, car_rows, NO_ROWS),
    "car, both simulators": (test_report_car.CONFIG, car_rows, frozenset({"physics"})),
    "explore": (test_report_explore.CONFIG, explore_rows, NO_ROWS),
}


def report(folder, sweep, change):
    """Write a sweep with every text changed and return its page."""
    config, rows, keep = SWEEPS[sweep]
    folder.mkdir(exist_ok=True)
    texts = {name: value if name in keep else changed(value, change) for name, value in config.items()}
    manifest = {
        "config": texts | {"env": [config["env"][0], change("more")], change("key"): [change("value"), "\ud800"]},
        "config_hash": change("0123456789abcdef"),
        "version": change("0.1.0"),
        "seed": 0,
        "episodes": len(rows()) + 1,
        "notices": {change("oak"): change("a door is shut")},
        change("key"): change("value"),
    }
    (folder / "sweep.json").write_text(json.dumps(manifest))
    lines = [json.dumps(changed_row(row, change, keep)) + "\n" for row in rows()]
    (folder / "episodes.jsonl").write_text("".join(lines))
    return write_report(folder).read_text()


@pytest.fixture
def undrawn(monkeypatch):
    """Leave out the drawing of figures, which takes most of the time; the slow test has it."""
    drawn = {name: lambda *_: b"a picture" for name in ("picture", "curves", "legend")}
    monkeypatch.setattr(page, "view_of", lambda env: replace(view_of(env), **drawn))
    for name in ("reached", "scenes"):
        monkeypatch.setattr(explore_figures, name, lambda *_: b"a picture")


@pytest.mark.parametrize("sweep", SWEEPS)
def test_no_text_of_a_sweep_becomes_markup(sweep, undrawn, tmp_path):
    like = report(tmp_path / "harmless", sweep, harmless)
    for kind, text in KINDS.items():
        shown = check_page(report(tmp_path / kind, sweep, suffix(text)), like)
        if kind == "markup":
            assert "astar<script>alert(1)</script>" in shown.text or "pointnav" not in sweep
            assert all(part in shown.text for part in MARKUP)
        if kind == "other":
            assert r"\x1b[31m" in shown.text
            assert r"\u202etxt.exe" in shown.text
            assert "[bold red]loud[/bold red]" in shown.text
    assert ("Sim to sim" in like) == (sweep == "car, both simulators")


@pytest.mark.slow
@pytest.mark.parametrize("sweep", SWEEPS)
def test_figures_and_maps_have_any_names_too(sweep, tmp_path):
    """Maps lie in files of their scene's name, which may hold all but a slash."""
    pages = {}
    for kind, text in {"harmless": "-harmless", **KINDS, "file": "<img src=x onerror=alert(1)>$\\frac$"}.items():
        folder = tmp_path / kind
        (folder / "maps").mkdir(parents=True)
        (folder / "explored").mkdir()
        if "/" not in text and len(text) < 200:
            box_map().save(folder / "maps" / f"arena{text}.npz")
            box_map().save(folder / "explored" / f"explored{text}")
        pages[kind] = report(folder, sweep, suffix(text))
    if sweep == "explore":
        assert "Final maps" in pages["harmless"]
    if sweep.startswith("car"):
        assert "Cost-to-go" in pages["harmless"]
    check_page(pages["file"], pages["harmless"])
    for kind in ("other", "long"):
        check_page(pages[kind], pages["markup"])


def test_every_text_of_the_schema_is_changed():
    """The walk reaches the fields that no row above has, and those of the models inside."""
    row = changed_row(explore_rows()[0] | {"failure": "f"}, suffix("!"))
    texts = {name for name, field in EpisodeRow.model_fields.items() if "str" in str(field.annotation)}
    plain = {name for name in texts if isinstance(row.get(name), str)}
    assert {"env", "scene", "scene_hash", "agent", "failure", "status", "tracer", "map_hash", "explored"} <= plain
    assert all(row[name].endswith("!") for name in plain - {"end_on"})
    assert "more!" in row["latency"]
    assert "more!" in row["budget"]
    EpisodeRow.model_validate(row)


@pytest.mark.parametrize("text", [*MARKUP, *OTHER, LONG])
def test_a_policy_may_have_any_name(text, undrawn, tmp_path):
    """Its label, with the hash that tells it from others of its name, is shown in the heading and in every table."""
    texts = [field.name for field in fields(PolicySpec) if field.type in (str, "str")]
    assert texts == ["name", "activation", "squash"]  # the last two are of a list
    policy, text = straight(), text[:LONGEST_POLICY_NAME]
    save(tmp_path / "policy.npz", replace(policy, spec=replace(policy.spec, name=text, trained={text: text})))
    name = label(tmp_path / "policy.npz")
    shown, like = (report_of_one(tmp_path, agent) for agent in (name, "astar"))
    assert name[-8:] in check_page(shown, like).text


def report_of_one(folder, agent):
    """Write a sweep of one episode of an agent and return its page."""
    config = test_report.CONFIG | {"agents": [agent]}
    manifest = {"config": config, "config_hash": "0", "version": "0", "seed": 0, "episodes": 1}
    (folder / "sweep.json").write_text(json.dumps(manifest))
    (folder / "episodes.jsonl").write_text(json.dumps(test_report.episode(agent, 0, True)) + "\n")
    return write_report(folder).read_text()


def test_a_row_leads_to_no_file_outside_its_folder(undrawn, tmp_path):
    """A name with a path in it is that of no map: the map beside the folder stays unread."""
    (tmp_path / "secret.npz").write_bytes(b"no map: reading it would be an error")
    config, rows, _ = SWEEPS["pointnav"]
    folder = tmp_path / "sweep"
    (folder / "maps").mkdir(parents=True)
    (folder / "sweep.json").write_text(
        json.dumps({"config": config, "config_hash": "0", "version": "0", "seed": 0, "episodes": 6})
    )
    lines = [json.dumps(row | {"scene": "../../secret"}) + "\n" for row in rows()]
    (folder / "episodes.jsonl").write_text("".join(lines))
    assert "../../secret" in write_report(folder).read_text()


@pytest.mark.parametrize("kind", KINDS)
def test_the_console_shows_names_as_they_are(kind, tmp_path, capsys):
    lines = [json.dumps(changed_row(row, suffix(KINDS[kind]), frozenset({"env"}))) + "\n" for row in pointnav_rows()]
    (tmp_path / "episodes.jsonl").write_text("".join(lines))
    print_results(tmp_path / "episodes.jsonl")
    said = capsys.readouterr().out
    assert "\x1b" not in said
    assert "n" * 201 not in said
    assert all(character.isprintable() or character == "\n" for character in said)
    if kind == "other":
        assert r"[bold red]loud[/bold red][/]:smile:\x00\x07\x1b[31m" in said.replace("\n", "")
