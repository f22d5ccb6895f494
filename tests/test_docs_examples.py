"""Execute the examples of CONTRIBUTING.md and of pages whose programs say more than that they run."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vssm_gym as vg
from tests.helpers.paths import CHECKOUT
from tests.inference.test_filters import DARK, DT, RATE, RIG, SPEED, follow, made, see
from tests.test_docs import fences
from tests.test_docs_tables import rows, section
from vssm_gym.agents.base import Agent
from vssm_gym.agents.registry import AGENTS
from vssm_gym.envs.sensors.registry import SENSORS
from vssm_gym.eval.bench.prediction import measure
from vssm_gym.eval.bench.prediction.contract import WorldModel
from vssm_gym.eval.metrics.metric import Metric
from vssm_gym.inference.registry import FILTERS
from vssm_gym.model.transition import PLANAR, RIGID, Rigid
from vssm_gym.model.transition.manifold import Manifold
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.grid_search.query import plan_by_search

pytestmark = pytest.mark.usefixtures("quick_compilation")
CONTRIBUTING = fences(CHECKOUT / "CONTRIBUTING.md")
MODEL = CHECKOUT / "docs" / "model.md"


def example(word: str) -> dict[str, Any]:
    """Execute the block of CONTRIBUTING.md that contains a word, and return its names."""
    [block] = [block for block in CONTRIBUTING if word in block]
    names: dict[str, Any] = {"__name__": "example"}
    exec(compile(block, "CONTRIBUTING.md", "exec"), names)
    return names


@pytest.fixture
def den(tmp_path: Path) -> Path:
    """Return the file of the complete example of a scene."""
    [text] = re.findall(r"^```json\n(.*?)^```", (CHECKOUT / "docs/scenes.md").read_text(), re.M | re.S)
    path = tmp_path / "den.json"
    path.write_text(text)
    return path


def test_the_complete_scene_loads_without_a_notice_and_drives(den):
    apartment = vg.load_scene(den)
    assert apartment.name == "den" and apartment.notes == ()
    assert set(json.loads(den.read_text())) | {"ceiling", "notes"} == set(type(apartment).model_fields)
    env = gym.make("vssm_gym/PointNav-v0", scene=str(den), noise="none", camera={"width": 32, "height": 24})
    observation, _ = env.reset(seed=0)
    assert np.isfinite(observation["depth"]).all() and 0.0 < observation["depth"].max() < 5.0
    assert observation["rgb"].std() > 5.0
    assert env.step(np.array([0.1, 0.0, 0.1, 0.0], np.float32))[0]["rgb"].shape == (24, 32, 3)
    env.close()


# contributing


def test_the_sensor_of_contributing_measures(monkeypatch):
    names = example("class OdometerConfig")
    monkeypatch.setitem(SENSORS, "odometer", names["OdometerConfig"])
    camera = {"width": 16, "height": 12}
    env = gym.make("vssm_gym/PointNav-v0", scene="fern", noise="none", camera=camera, sensors=["odometer"])
    observation, info = env.reset(seed=0)
    places = [info["T_world_cam"][:2, 3]]
    for _ in range(6):
        observation, *_, info = env.step(np.array([0.2, 0.0, 0.1, 0.0], np.float32))
        places.append(info["T_world_cam"][:2, 3])
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()  # the camera stands on the robot's axis
    assert moved > 0.1
    assert observation["odometer"][0] == pytest.approx(moved, abs=1e-3)
    env.close()


def test_the_sensor_of_contributing_refuses_bad_noise(monkeypatch):
    config = example("class OdometerConfig")["OdometerConfig"]
    monkeypatch.setitem(SENSORS, "odometer", config)
    for std in (-1.0, float("nan"), float("inf")):
        with pytest.raises(vg.InputError, match="OdometerConfig: std: expected a finite standard deviation"):
            config(std=std)
    with pytest.raises(vg.InputError, match="std"):
        gym.make("vssm_gym/PointNav-v0", scene="fern", sensors=[{"sensor": "odometer", "std": -1.0}])


def test_the_search_of_contributing_finds_the_shortest_path():
    search = example("def search(query: Query)")["search"]
    x, y = np.meshgrid(np.arange(0.0, 3.0, 0.05), np.arange(0.0, 2.0, 0.05), indexing="ij")
    wall = np.maximum(np.abs(x - 1.5) - 0.1, np.abs(y - 0.4) - 0.8)  # negative inside; a gap above y = 1.2
    space = ClearanceMap.from_occupancy(-np.minimum(wall, np.minimum(y - 0.05, 1.9 - y)), np.zeros(2), 0.05)
    start, goal = np.array([0.5, 0.5]), np.array([2.5, 0.5])
    limits = {"margin": 0.0, "goal_radius": 0.0, "max_expansions": 100_000, "shorten": True}
    found = plan_by_search(search, start, goal, space, 0.1, **limits)
    assert found.found
    assert found.cost == pytest.approx(vg.plan(start, goal, space, 0.1).cost, rel=0.01)
    assert not plan_by_search(search, start, goal, space, 0.5, **limits).found


def test_the_metric_of_contributing_is_a_number_of_a_row():
    metric = example("MEAN_STEP")["MEAN_STEP"]
    assert isinstance(metric, Metric)
    assert metric.function({"path_length": 3.0, "steps": 20}) == pytest.approx(0.15)
    assert metric.function({"path_length": 0.0, "steps": 0}) is None


def test_the_agent_of_contributing_drives_to_the_goal(monkeypatch, den):
    kind = example("class StraightAgent")["StraightAgent"]
    monkeypatch.setitem(AGENTS, kind.name, kind)
    env = gym.make("vssm_gym/PointNav-v0", scene=str(den), noise="none", camera={"width": 16, "height": 12})
    arrived = 0
    for seed in range(4):
        observation, info = env.reset(seed=seed)
        agent = vg.make_agent("straight")
        assert isinstance(agent, Agent)
        agent.reset(vg.agent_context(env, info), observation, seed=0)
        over, hit = False, False
        while not over:
            decision = agent.act(observation)
            observation, _, terminated, truncated, info = env.step(decision.action)
            over, hit = terminated or truncated, hit or info["collision"]
        assert terminated, "it stops by itself"
        assert info["success"] or hit, "dead reckoning is exact without noise"
        arrived += info["success"]
    assert arrived
    env.close()


@pytest.mark.slow
def test_the_python_of_contributing_is_typed(tmp_path):
    for number, block in enumerate(CONTRIBUTING):
        (tmp_path / f"example_{number}.py").write_text(block)
    files = sorted(map(str, tmp_path.glob("*.py")))
    assert len(files) == 4
    # a cache of its own: what the cache of `make lint` holds decides nothing; the package is read, not judged
    own = ["--cache-dir", str(tmp_path / "cache"), "--follow-imports", "silent"]
    strict = ["--config-file", str(CHECKOUT / "pyproject.toml"), "--disallow-untyped-defs"]
    mypy = [sys.executable, "-m", "mypy", *own, *strict]
    done = subprocess.run([*mypy, *files], cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# docs/prediction.md


def test_importing_the_model_of_the_page_measures_nothing(monkeypatch):
    """The benchmark imports the file of an entry."""
    [block] = [block for block in fences(CHECKOUT / "docs" / "prediction.md") if "class StandingStill" in block]
    monkeypatch.setattr(measure, "measure", lambda **_: pytest.fail("a measurement has begun"))
    names: dict[str, Any] = {"__name__": "still"}
    exec(compile(block, "prediction.md", "exec"), names)
    assert isinstance(names["StandingStill"](), WorldModel)
    names["__name__"] = "__main__"
    with pytest.raises(pytest.fail.Exception, match="has begun"):
        exec(compile(block, "prediction.md", "exec"), names)


# docs/model.md: what a filter takes from its transition


def unicycle() -> type[vg.Transition]:
    """Return the class that the page defines, whose program also makes a filter for it."""
    [block] = [block for block in fences(MODEL) if "class Unicycle" in block]
    names: dict[str, Any] = {"__name__": "example"}
    exec(compile(block, str(MODEL), "exec"), names)
    assert isinstance(names["prism"], vg.Prism)
    return names["Unicycle"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["prism", "adam"])  # the next test steps the others with it
def test_a_filter_follows_a_body_by_the_transition_of_the_page(name):
    follow(name, unicycle()(), lambda k: jnp.array([SPEED, RATE]))


class Members:
    """Record which members of a transition and its manifold are read; what those read in turn does not count."""

    def __init__(self) -> None:
        self.transition: set[str] = set()
        self.manifold: set[str] = set()
        self.inside = 0

    def recorded(self, members: set[str], name: str, value: Any) -> Any:
        if not self.inside:
            members.add(name)
        if not callable(value):
            return value

        def called(*args: Any, **keywords: Any) -> Any:
            self.inside += 1
            try:
                return value(*args, **keywords)
            finally:
                self.inside -= 1

        return called


class Watched:
    """Read a class attribute or bind a method, and record it."""

    def __init__(self, members: Members, name: str, value: Any) -> None:
        self.members, self.name, self.held = members, name, value

    def __get__(self, instance: Any, owner: type) -> Any:
        value = self.held.__get__(instance, owner) if callable(self.held) else self.held
        return self.members.recorded(self.members.transition, self.name, value)


def watched(base: type[vg.Transition], manifold: Manifold) -> tuple[type[vg.Transition], Members]:
    """Return a transition like ``base`` that records what is read of it."""
    members = Members()

    class Space(type(manifold)):  # type: ignore[misc]
        """Answer as the manifold does; equal to itself alone, as what was compiled for an equal one reads nothing."""

        __eq__, __hash__ = object.__eq__, object.__hash__

        def __getattribute__(self, name: str) -> Any:
            value = super().__getattribute__(name)
            caller = sys._getframe(1).f_globals["__name__"]  # the checker of annotations reads every member
            ours = caller.startswith("vssm_gym.") and not name.startswith("__")
            return members.recorded(members.manifold, name, value) if ours else value

    class Copy(base):  # type: ignore[misc, valid-type]
        """Move as the base does."""

    Copy.manifold = Space()
    for name in {*dir(vg.Transition), "controls", "commanded"}:
        if not name.startswith("_") and name != "manifold":
            setattr(Copy, name, Watched(members, name, getattr(Copy, name)))
    return Copy, members


def taken(name: str, commanded: bool) -> tuple[set[str], set[str]]:
    """Return what a filter reads over four images, of which the third shows nothing."""
    base, manifold = (unicycle(), PLANAR) if commanded else (Rigid, RIGID)
    kind, members = watched(base, manifold)
    transition, control = kind(), jnp.array([SPEED, RATE]) if commanded else jnp.zeros(6)
    _, prior = made(name, base())
    belief = vg.GaussianBelief(prior.belief.mean, prior.belief.covariance, kind.manifold)
    for read in (members.transition, members.manifold):
        read.clear()
    one = FILTERS[name].make(RIG, transition)
    state = one.init(vg.Posterior(belief, prior.map), see(0), jax.random.key(0))
    for image in (see(1), DARK, see(3 if commanded else 1)):
        state, _ = one.step(state, control, image, DT)
    return members.transition, members.manifold


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "commanded"),
    [(name, True) for name in FILTERS if name != "adam"] + [("prism", False), ("tracker", False)],  # adam: a tracker
)
def test_the_page_says_what_a_filter_takes_from_its_transition(name, commanded):
    table = list(rows(section(MODEL, "What a filter takes from its transition")))[1:]
    mine = [cells for cells in table if f"`{name}`" in cells[0]]
    if len(mine) > 1:
        mine = [cells for cells in mine if ("of a commanded body" in cells[0]) == commanded]
    [(_, transition, manifold)] = mine
    stated = tuple(set(re.findall(r"`(\w+)`", cell)) for cell in (transition, manifold))
    assert taken(name, commanded) == stated


def test_a_reader_of_the_table_finds_every_filter():
    table = list(rows(section(MODEL, "What a filter takes from its transition")))[1:]
    assert {name for cells in table for name in re.findall(r"`(\w+)`", cells[0])} == set(FILTERS)
