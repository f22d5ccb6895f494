"""Test what the site is generated from: every public name, every id, every committed baseline has its place."""

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
from PIL import Image

import vssm_gym as vg
from tests.helpers.paths import CHECKOUT
from vssm_gym.envs.registration import ENVIRONMENTS

DOCS = CHECKOUT / "docs"
MARK = re.compile(r"^<!-- site: (\w+)(.*?)-->$", re.MULTILINE | re.DOTALL)
OTHER_EXTRAS = [
    *("stable_baselines3", "torch", "pybullet", "minari", "h5py", "pyarrow", "ray"),
    *("pygame", "rerun", "imageio_ffmpeg", "moviepy", "evo", "imageio", "beartype"),
]
LARGEST = 400_000  # bytes of a moving picture


@pytest.fixture
def module(monkeypatch):
    """Return a function that imports a module of ``docs/site``, none of which needs Sphinx."""
    monkeypatch.syspath_prepend(str(DOCS / "site"))
    imported = []

    def load(name: str) -> ModuleType:
        imported.append(name)
        return importlib.import_module(name)

    yield load
    for name in imported:
        sys.modules.pop(name, None)


def marks(page: Path) -> list[tuple[str, list[str]]]:
    """List what a page asks to be generated: names of generators, and their arguments."""
    return [(name, arguments.split()) for name, arguments in MARK.findall(page.read_text())]


def test_the_reference_has_every_public_name_once():
    listed = [
        name
        for page in (DOCS / "reference").glob("*.md")
        for generator, names in marks(page)
        if generator == "reference"
        for name in names
    ]
    assert sorted(listed) == sorted(vg.PUBLIC)


def test_the_reference_has_the_names_that_the_pages_import(module):
    reference = module("reference")
    text = reference.imported()
    assert "vssm_gym.envs.wrappers.RelativeGoal" in text
    assert "vssm_gym.training.sb3.vec_env.SB3VecEnv" in text
    assert "vssm_gym.model.emission.RGBD" not in text  # public: it has its entry
    assert ":: vssm_gym.envs.pointnav.PointNavEnv" in reference.environment_classes()
    assert ":: vssm_gym.envs.phased.PhasedEnv()" in reference.environment_bases()
    assert "PhasedEnv" not in text and "vssm_gym.envs.simulation.Simulation" not in text


def test_each_environment_has_its_own_first_sentence_and_states_its_keywords(module):
    reference = module("reference")
    kinds = {reference.target(spec.env.replace(":", ".")) for spec in ENVIRONMENTS.values()}
    sentences = [inspect.getdoc(kind).partition(".")[0] for kind in kinds]
    assert len(set(sentences)) == len(kinds)
    for kind in kinds:
        taken = inspect.signature(kind).parameters
        assert "render_mode" in taken and not {"given", "simulation", "navigation", "keywords"} & taken.keys()


def test_the_reference_needs_no_extra_but_docs():
    """The modules that the pages import from load where the libraries of the other extras are not installed."""
    code = (
        "import importlib.machinery as machinery, sys\n"
        "find = machinery.PathFinder.find_spec\n"
        f"absent = lambda name: name.partition('.')[0] in {OTHER_EXTRAS}\n"
        "machinery.PathFinder.find_spec = lambda name, *more: None if absent(name) else find(name, *more)\n"
        f"sys.path.insert(0, {str(DOCS / 'site')!r})\n"
        "import reference, stand_ins\n"
        "stand_ins.install()\n"
        "print(reference.imported())"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert "vssm_gym.training.sb3.vec_env.SB3VecEnv" in done.stdout, done.stderr[-2000:]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_every_id_has_its_table_and_its_moving_picture(name):
    [page] = [page for page in (DOCS / "envs").glob("*.md") if ("environment", [name]) in marks(page)]
    picture = f"images/drives/{name.partition('/')[2]}.gif"
    assert f"](../{picture})" in page.read_text()
    assert (DOCS / picture).stat().st_size <= LARGEST
    with Image.open(DOCS / picture) as moving:
        assert moving.n_frames >= 20


def test_every_moving_picture_can_be_made_anew(module):
    assert sorted(f"vssm_gym/{name}" for name in module("moving_pictures").DRIVES) == sorted(ENVIRONMENTS)


def test_the_table_of_an_id_states_spaces_and_agents(module):
    text = module("environments").environment("vssm_gym/LidarMaze-v0")
    assert "| most steps | 1000 |" in text
    assert "`dist_bug`" in text
    assert "| observation, `goal` | `Box(" in text


def test_every_baseline_has_its_row(module):
    results = module("results")
    named = {name.partition("/")[0] for names, _, _ in results.described() for name in names}
    assert named == {path.name for path in results.BASELINES.iterdir() if path.is_dir()}
    assert all(re.search(r"\b[0-9a-f]{7,8}\b", commit) for _, commit, _ in results.described())


def test_the_results_state_intervals(module):
    results = module("results")
    car, study = (
        results.figures(results.BASELINES / name).replace(results.SPACE, " ")
        for name in ("slam_car", "prediction/test.json")
    )
    assert "| slam_car | 40 | 97.5 [86.8, 99.9] |" in car
    assert "| VSSM-LM, 1.0 seconds, nats | 4.7 [4.33, 5.06] |" in study


@pytest.mark.parametrize(
    ("written", "read"),
    [
        (["A * b and |c|."], [r"A \* b and \|c\|."]),
        (["Return ``a*b`` of :class:`x_`."], ["Return ``a*b`` of :class:`x_`."]),
        (["First.", "", "    a = b * c", "", "Last."], ["First.", "", "::", "", "    a = b * c", "", "Last."]),
        (["First.", "", "Args:", "    a: b."], ["First.", "", "Args:", "    a: b."]),
    ],
)
def test_docstrings_are_read_as_written(module, written, read):
    pytest.importorskip("sphinx", reason="needs the extra docs")
    assert module("docstrings").readable(written) == read


@pytest.mark.parametrize(
    "content",
    [
        '<script src="//cdn.example/x.js"></script>',
        '<img src="a.png" srcset="a.png 1x, https://cdn.example/a.png 2x">',
        '<video poster="http://cdn.example/a.png"></video>',
        '<object data="https://cdn.example/a.svg"></object>',
        "<p style=\"background: url('//cdn.example/a.png')\">",
    ],
)
def test_what_is_loaded_from_elsewhere_is_found(module, tmp_path, content):
    (tmp_path / "a.png").write_bytes(b"")
    (tmp_path / "page.html").write_text(f'<a href="https://example.org">read</a><img src="a.png">{content}')
    assert [fault.split()[:2] for fault in module("check_links").faults(tmp_path)] == [["page.html", "loads"]]


def test_a_style_sheet_loads_nothing_from_elsewhere(module, tmp_path):
    (tmp_path / "ours.css").write_text("@import 'b.css'; p { background: url(data:image/png;base64,AA) }")
    assert not list(module("check_links").faults(tmp_path))
    (tmp_path / "ours.css").write_text('@import "https://fonts.example/a.css"; p { src: url( //cdn.example/f.woff ) }')
    assert len(list(module("check_links").faults(tmp_path))) == 2
