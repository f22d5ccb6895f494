"""Hold tables of the pages to the registries and constants that they list."""

import dataclasses
import importlib
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.paths import CHECKOUT
from vssm_gym.agents.base import AgentContext, Decision
from vssm_gym.agents.registry import AGENTS
from vssm_gym.envs import maze_noise
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.envs.scenes.scene import built_in_scenes
from vssm_gym.envs.sensors import gps_compass, imu, lidar, rgbd_noise
from vssm_gym.envs.sensors.registry import SENSORS
from vssm_gym.envs.textures.registry import TEXTURES
from vssm_gym.eval.benchmark import results
from vssm_gym.eval.benchmark.manifest import read_manifest
from vssm_gym.eval.benchmark.suite import SUITES, DrivingTrack, PredictionTrack, SlamTrack, read_suite
from vssm_gym.eval.metrics.registry import METRICS
from vssm_gym.inference.registry import FILTERS
from vssm_gym.planning.planners import PLANNERS

DOCS = CHECKOUT / "docs"


def rows(text: str) -> Iterator[list[str]]:
    """Yield the cells of the rows of a text's tables; a pipe inside a cell is escaped."""
    for line in text.splitlines():
        if line.startswith("|") and not line.startswith("|--"):
            yield [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip()[1:-1])]


def section(page: Path, heading: str) -> str:
    """Return the text under a heading, up to the next one of its level or above."""
    text = page.read_text()
    level, start = next((len(m[1]), m.end()) for m in re.finditer(r"^(#+) (.+)$", text, re.M) if m[2] == heading)
    end = re.search(rf"^#{{1,{level}}} ", text[start:], re.M)
    return text[start : start + end.start()] if end else text[start:]


def named(text: str) -> set[str]:
    """Return the names in backticks in the first cells of a text's tables."""
    return {name for cells in rows(text) for name in re.findall(r"`([^`]+)`", cells[0])}


# registries


def test_every_sensor_stands_on_its_page():
    keywords = re.findall(r'`sensors=\["(\w+)"\]`', (DOCS / "sensors.md").read_text())
    assert sorted(set(keywords)) == sorted(SENSORS)


def test_every_field_of_a_suites_track_stands_on_its_page():
    fields = {name for track in (DrivingTrack, SlamTrack, PredictionTrack) for name in track.model_fields}
    assert fields == named(section(DOCS / "benchmark.md", "A suite is a file"))


def test_every_planner_stands_on_its_page():
    assert set(PLANNERS) <= named(section(DOCS / "planning.md", "Planners of a disc"))


def test_every_metric_stands_on_its_page_as_the_tables_show_it():
    table = list(rows(section(DOCS / "evaluation.md", "Metrics")))[1:]
    shown = {cells[0].strip("`"): tuple(cells[1:4]) for cells in table}
    assert shown == {name: (m.label, m.direction, ", ".join(m.reports)) for name, m in METRICS.items()}


@pytest.mark.parametrize("name", AGENTS)
def test_every_agent_stands_on_the_page_that_its_file_names(name):
    text = importlib.import_module(AGENTS[name].__module__).__doc__ or ""
    [page] = re.findall(r"docs/agents/\w+\.md", text)
    assert name in named((CHECKOUT / page).read_text())


def test_every_filter_stands_on_its_page():
    assert set(FILTERS) == named(section(DOCS / "model.md", "Running a filter"))


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_environment_has_a_page_that_the_readme_and_the_index_link(name):
    short = name.partition("/")[2]
    [page] = re.findall(rf"\[`{short}`\]\(docs/(envs/\w+\.md)\)", (CHECKOUT / "README.md").read_text())
    assert re.search(rf"^#+ `{name}`$", (DOCS / page).read_text(), re.MULTILINE)
    assert f"({page})" in (DOCS / "index.md").read_text()


def test_every_texture_stands_on_its_page():
    listed = [
        name
        for cells in list(rows(section(DOCS / "scenes.md", "Textures")))[1:]
        for name in re.findall(r"`(\w+)`", cells[1])
    ]
    assert sorted(listed) == sorted(TEXTURES)


def test_every_built_in_scene_stands_on_its_page():
    assert set(built_in_scenes()) <= named(section(DOCS / "scenes.md", "Built-in scenes"))


@pytest.mark.parametrize("kind", [AgentContext, Decision])
def test_the_fields_of_what_an_agent_knows_and_returns_stand_in_the_library(kind):
    head = f"| field of `{kind.__name__}` |"
    [table] = [text for text in (DOCS / "library.md").read_text().split("\n\n") if text.startswith(head)]
    listed = [cells[0].strip("`") for cells in list(rows(table))[1:]]
    assert listed == [field.name for field in dataclasses.fields(kind)]


# levels of noise

PIXEL = rgbd_noise.PIXEL
UNITS = {"mm": 1e-3, "mm/m²": 1e-3, "mm m^½": 1e-3, "m": 1.0, "px": PIXEL, "%": 1e-2, "°": math.radians(1.0), "s": 1.0}
UNITS |= {"grey levels": 1.0, "1/m²": 1.0}
UNITS |= dict.fromkeys(["m/s²/√Hz", "m/s³/√Hz", "m/s²", "rad/s/√Hz", "rad/s²/√Hz", "rad/s"], 1.0)
LEVELS = {
    "RGB-D camera": rgbd_noise.PRESETS,
    "LiDAR": lidar.PRESETS,
    "maze scanner": maze_noise.RANGE_NOISE,
    "GPS and compass": gps_compass.PRESETS,
    "IMU": imu.PRESETS,
}


def noise_table() -> dict[str, tuple[list[str], list[list[str]]]]:
    """Return the levels and the rows of every sensor in the table of noise."""
    found: dict[str, tuple[list[str], list[list[str]]]] = {}
    for cells in list(rows(section(DOCS / "sensors.md", "Noise levels")))[1:]:
        if sensor := re.match(r"\*\*(.+?)\*\*", cells[0]):
            levels, lines = [cell.strip("`") for cell in cells[2:5] if cell], []
            found[sensor[1]] = levels, lines
        else:
            lines.append(cells)
    return found


@pytest.mark.parametrize("sensor", LEVELS)
def test_the_table_of_noise_states_every_level_in_its_unit(sensor):
    presets = dict(LEVELS[sensor])
    levels, lines = noise_table()[sensor]
    none = presets.pop("none")
    assert levels == list(presets)
    assert [cells[0].strip("`") for cells in lines] == [field.name for field in dataclasses.fields(none)]
    for cells in lines:
        for level, text in zip(levels, cells[2:5], strict=False):
            value = getattr(presets[level], cells[0].strip("`"))
            assert value == pytest.approx(float(text) * UNITS[cells[1]], rel=5e-3), (cells[0], level)


def test_the_table_of_noise_has_every_sensor_that_errs():
    assert list(noise_table()) == list(LEVELS)


# contributing, and questions


def test_every_new_thing_has_a_test_to_copy():
    table = list(rows(section(CHECKOUT / "CONTRIBUTING.md", "Where a new thing goes")))[1:]
    assert len(table) >= 13
    for cells in table:
        [path] = re.findall(r"`(tests/[\w/]+\.py)`", cells[4])
        assert (CHECKOUT / path).is_file(), cells[0]


# What the linked section must contain to answer the question.
ANSWERS = {
    "camera's pose": "p_world = T_world_cam @ p_cam",
    "noise of the depth": "rgbd_noise.py",
    "equation such as I12": "`vssm_gym.inference.alignment.adam",
    "a picture was taken": "vssm-gym navigate --scene oak --map oak --goal picture.png",
    "own camera": "prism.step(",
    "render a view": "vg.render(",
    "covariance of the belief": "info.belief.covariance",
    "own robot's transition": "class Unicycle(vg.Transition)",
    "own agent": "@vg.register_agent",
    "enter the benchmark": 'project.entry-points."vssm_gym.slam"',
    "train a policy": "vssm-gym evaluate",
    "episode log": "`failure`",
    "own apartment": "scene import",
    "episodes of Habitat": "vssm-gym dataset from-habitat",
    "texture": "TEXTURES",
}


def linked(page: Path, target: str) -> str:
    """Return the text that a link of a page leads to: a section, an equation's entry, or a whole page."""
    path, _, anchor = target.partition("#")
    text = (page.parent / path).read_text()
    if f'<a id="{anchor}">' in text:
        return re.split(r"^(?=<a id=)|^(?=#)", text[text.index(f'<a id="{anchor}">') :], flags=re.M)[1]
    for heading in re.findall(r"^#+ (.+)$", text, re.M):
        if re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") == anchor:
            return section(page.parent / path, heading)
    return text


def test_common_questions_are_answered_where_they_point():
    """Two links from the README: the index, then the answer."""
    assert "(docs/index.md)" in (CHECKOUT / "README.md").read_text().partition("## Start")[0]
    index = DOCS / "index.md"
    table = list(rows(section(index, "Common questions")))[1:]
    assert len(table) == len(ANSWERS)
    for question, answer in table:
        [said] = [text for words, text in ANSWERS.items() if words in question]
        target = re.findall(r"\]\(([^)]+)\)", answer)[0]
        assert said in linked(index, target), f"{question} {target}"


def test_the_page_of_the_benchmark_shows_the_references():
    """Scores, successes and contacts in its table are those of the committed rows, best first."""
    suite = read_suite(SUITES / "small-v1.yaml")
    first, *others = sorted(results.REFERENCES.glob("small-v1*"))
    manifests = {folder: read_manifest(folder) for folder in others}
    expected = [
        [f"`{table.name}`", f"`{place.line.entry}`", place.line.score.text(table.score.digits), *_outcomes(place.line)]
        for table in results.tables(suite, first, manifests)
        for place in table.places
    ]
    shown = list(rows(section(DOCS / "benchmark.md", "References")))[1:]
    assert [cells[:5] for cells in shown] == expected


def _outcomes(line):
    """Return the cells of success and contacts."""
    contacts = "-" if line.collisions is None else f"{line.collisions:.2f}"
    return [f"{100.0 * line.success:.0f} %", contacts]
