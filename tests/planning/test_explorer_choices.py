"""Test the choices of explorers, and their rate, in beliefs made by hand whose right choice is evident."""

import itertools
import math
from dataclasses import replace
from typing import Any

import equinox as eqx
import numpy as np
import pytest

from tests.agents.test_explorers import EXPLORERS
from tests.planning.test_frontier import drawn
from vssm_gym.agents.exploration import mi_explorer
from vssm_gym.agents.exploration.frontier_gain_scan import FrontierGainScan, FrontierGainScanConfig
from vssm_gym.agents.exploration.frontier_nearest import NearestFrontier
from vssm_gym.agents.exploration.mi_explorer import MiExplorerConfig, MutualInformation
from vssm_gym.agents.exploration.random_viewpoint import RandomViewpoint, RandomViewpointConfig
from vssm_gym.agents.registry import AGENTS
from vssm_gym.agents.shared.explorer import ExplorationConfig
from vssm_gym.agents.shared.frontier_gain import FrontierGain, FrontierGainConfig
from vssm_gym.agents.shared.own_map import OwnMapConfig
from vssm_gym.agents.shared.strategy import Choice, ExplorationStrategy, Situation
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.geometry.camera import Camera
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_STD, VoxelMap
from vssm_gym.planning.exploration.candidates import Roadmap
from vssm_gym.planning.exploration.information import Gain
from vssm_gym.planning.floor_plan import FloorPlan

ROOM = 0.18  # m of clearance that a way needs
# A corridor 10 m long and 1 m wide. Beyond its left end 0.5 m^2 are unknown, beyond its right end 2 m^2.
LEFT, FREE, RIGHT = 5, 100, 20  # cells of 10 cm
CORRIDOR = drawn("\n".join(["#" * 127, *["#" + "?" * LEFT + "." * FREE + "?" * RIGHT + "#"] * 10, "#" * 127]))


def believed(plan: FloorPlan, xy: tuple[float, float], **more: Any) -> Situation:
    """Return the situation of a robot at ``xy`` (m) in a plan, facing along x; ``more`` replaces fields."""
    robot = HolonomicRobot()
    roadmap = Roadmap.of(plan, np.array(xy), ROOM)
    camera = Camera.from_hfov(64, 48, 0.5 * math.pi)
    nothing: Any = None
    situation = Situation(
        nothing, roadmap, np.array([*xy, 0.0]), np.zeros(3), camera, robot.T_body_cam, np.empty((0, 2)), False
    )
    return replace(situation, **more)


def chosen(strategy: ExplorationStrategy, situation: Situation) -> Choice:
    """Return a strategy's first choice."""
    strategy.reset(0)
    choice = strategy.choose(situation)
    assert choice is not None
    return choice


def test_the_nearest_frontier_has_the_shortest_path():
    for x, end in ((5.0, 0.6), (6.0, 10.5)):
        goal = chosen(NearestFrontier(), believed(CORRIDOR, (x, 0.55))).goal
        assert goal is not None
        assert abs(goal[0] - end) < 0.5


@pytest.mark.parametrize("looking", [False, True])
def test_gain_at_the_frontier_is_weighed_against_path_length(looking):
    """Four times the area outweighs a path that is up to log(4) / 0.2 = 6.9 m longer."""
    strategy = FrontierGainScan(FrontierGainScanConfig()) if looking else FrontierGain(FrontierGainConfig())
    for x, end in ((5.0, 10.5), (2.5, 10.5), (1.5, 0.6)):  # ways to the left end shorter by 1, 5 and 8 m
        choice = chosen(strategy, believed(CORRIDOR, (x, 0.55)))
        assert choice.goal is not None
        assert abs(choice.goal[0] - end) < 0.5, choice.status
        assert choice.target is not None
        assert abs(np.ptp(choice.target[:, 1]) - 0.9) < 0.01  # the whole end, ten cells


def test_a_scanning_explorer_turns_once_in_every_metre():
    strategy = FrontierGainScan(FrontierGainScanConfig())
    strategy.reset(0)
    turns = []
    for k in range(23):
        choice = strategy.choose(believed(CORRIDOR, (2.0 + 0.16 * k, 0.55), arrived=k == 0))
        assert choice is not None
        if choice.goal is None:
            turns.append(k)
    assert turns == [7, 14, 21]  # 1.12 m


def test_random_viewpoints_are_not_visited_twice():
    """A visited place has no gain any more, so that the robot stops although its map never changes."""
    strategy = RandomViewpoint(RandomViewpointConfig())
    strategy.reset(3)
    at, goals = (5.0, 0.55), []
    choice = strategy.choose(believed(CORRIDOR, at, arrived=True))
    while choice is not None:
        assert choice.goal is not None
        on_the_way = strategy.choose(believed(CORRIDOR, at))
        assert on_the_way is not None
        assert on_the_way.goal is choice.goal
        goals.append(choice.goal)
        assert len(goals) < 100
        at = (float(choice.goal[0]), float(choice.goal[1]))
        choice = strategy.choose(believed(CORRIDOR, at, arrived=True))
    assert len(goals) > 5
    assert min(math.dist(a, b) for a, b in itertools.combinations(goals, 2)) >= MiExplorerConfig.same_place


def test_an_unreached_random_viewpoint_can_be_drawn_again():
    strategy = RandomViewpoint(RandomViewpointConfig())
    strategy.reset(3)
    for _ in range(60):  # carried out, and always still where it began
        assert strategy.choose(believed(CORRIDOR, (5.0, 0.55), arrived=True)) is not None


# A corridor 12.5 m long with three unseen niches in its upper wall, at these x (m).
NICHES = np.array([1.0, 9.0, 11.0])
GAINS = np.array([13.0, 30.0, 40.0])  # 1000 nats, of a full turn in front of each


def with_niches() -> FloorPlan:
    """Return the corridor with niches, each 40 cm wide and 50 cm deep."""
    unknown = [any(abs(0.1 * i - x) < 0.21 for x in NICHES) for i in range(126)]
    wall = "".join("?" if u else "#" for u in unknown)
    return drawn("\n".join(["#" * 126, *["#" + "." * 124 + "#"] * 10, *[wall] * 5, "#" * 126]))


def gains_by_hand(_map: Any, views: np.ndarray, paths: np.ndarray, *_rest: Any) -> Gain:
    """Return gains by hand: that of the first place in front of each niche, and none for other views of it."""
    away = np.abs(views[paths[0], None, 0, 3] - NICHES)
    gained, seen = np.zeros(len(away)), set()
    for k, (niche, gap) in enumerate(zip(away.argmin(axis=1), away.min(axis=1), strict=True)):
        if gap < 0.8 and niche not in seen:
            seen.add(niche)
            gained[k] = 1e3 * GAINS[niche]
    return Gain(np.array([gained.sum()]), np.cumsum(gained)[None], np.zeros(len(views)))


@pytest.mark.parametrize(
    ("config", "niche"),
    [
        # The first one has 13 in 2 m: more per metre than 30 in 6 m, or 40 in 8 m. But these two are on one path,
        # 70 in 8 m, and lose more by waiting for it than it does.
        (MiExplorerConfig(), 1),
        (MiExplorerConfig(mode="rate"), 0),
        (MiExplorerConfig(mode="difference", price=0.0), 2),
        (MiExplorerConfig(mode="difference", price=10_000.0), 0),
    ],
)
def test_the_explorer_goes_to_the_place_of_its_mode(config, niche, monkeypatch):
    monkeypatch.setattr(mi_explorer, "gain_of_paths", gains_by_hand)
    plan = with_niches()
    nothing_known = VoxelMap.prior(np.array([0.0, 0.0, 0.0]), 0.1, (128, 24, 8))
    situation = believed(plan, (3.0, 0.55), map=nothing_known)
    strategy = MutualInformation(replace(config, least_look=math.inf))  # no view from here: a place
    choice, tour, roadmap = chosen(strategy, situation), strategy.tour, situation.roadmap
    assert tour is not None
    assert choice.goal is not None
    assert np.abs(choice.goal[0] - NICHES[niche]) < 0.8
    assert np.array_equal(choice.goal, tour.xy[tour.first])
    # One place for each niche, with its gain less the price of a place, about as far away as drawn.
    which = np.abs(tour.xy[:, :1] - NICHES).argmin(axis=1)
    assert sorted(which) == [0, 1, 2]
    assert tour.nats == pytest.approx(1e3 * GAINS[which] - config.least_gain)
    assert np.abs(roadmap.at(roadmap.distance, tour.xy) - np.abs(NICHES[which] - 3.0)).max() < 0.6


def test_an_explorer_stops_where_all_cells_were_observed():
    """Cells that were observed have no gain, although another reading would always raise their precision.

    The hypothesis is that what is left of their error is common to all readings: of the pose, the calibration and the
    shape of the surface within a cell. It does not average out, whereas the model takes errors as independent and
    promises ``1/2 log(1 + 1/n)`` nats for reading ``n + 1``. That is little for a cell, but the known cells are many:
    together they would outweigh every unseen place, and the robot would look at them for ever.
    """
    plan = drawn("\n".join(["#" * 126, *["#" + "." * 124 + "#"] * 22, "#" * 126]))
    prior = VoxelMap.prior(np.array([0.0, 0.0, 0.0]), 0.1, (128, 24, 8))
    once = prior.occupancy_precision + 1.0  # every cell was read once
    half = prior.dense(once).at[64:].set(PRIOR_OCCUPANCY_STD**-2)
    for precision, looks in ((once, False), (prior.blocked(half), True)):
        known = eqx.tree_at(lambda m: m.occupancy_precision, prior, precision)
        strategy = MutualInformation(MiExplorerConfig())
        strategy.reset(0)
        choice = strategy.choose(believed(plan, (5.0, 1.15), map=known))
        assert (choice is not None) == looks


@pytest.mark.parametrize("name", EXPLORERS)
def test_all_explorers_choose_again_at_the_same_rate(name):
    """Driver, margins and map are the same too, so that scores differ by the choices alone."""
    explorer = AGENTS[name]()._explorer
    assert explorer._config == ExplorationConfig()
    assert explorer._own_config == OwnMapConfig()
