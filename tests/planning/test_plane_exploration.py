"""Test exploration in the plane: information of sampled scans, refined control sequences, roads, and the choice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.envs.physics.planar import clearance, scan
from vssm_gym.envs.tasks.mazes import load_maze
from vssm_gym.errors import InputError
from vssm_gym.inference.planar.config import PlanarConfig
from vssm_gym.inference.planar.scan_update import update
from vssm_gym.maps.planar_map import PlanarMap
from vssm_gym.model.scan_emission import OccupancyScans
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief
from vssm_gym.planning.exploration.plane.choice import PlaneChoiceConfig, choose
from vssm_gym.planning.exploration.plane.controls import (
    ControlSearchConfig,
    controls_of,
    penalty,
    random_turns,
    refine,
    trajectories,
)
from vssm_gym.planning.exploration.plane.information import SampledInformationConfig, facing_x, scan_information
from vssm_gym.planning.exploration.plane.roads import PlaneRoads

MAZE = load_maze("pillars-v1")
LIMITS = np.array([np.radians(30.0), 0.02])
TRANSITION = Planar(MotionNoise(0.006, 0.0005), (0.001, 0.001, 0.001))
SMALL = SampledInformationConfig(draws=10, maps=2)


def scanner(beams: int, reach: float) -> Scanner:
    angles = jnp.asarray(2.0 * np.pi * np.arange(beams) / beams, jnp.float32)
    return Scanner(angles, jnp.zeros(3), jnp.float32(reach))


def mapped(states: np.ndarray, reach: float = 1.5) -> PlanarMap:
    """Return the map of exact scans from places of the maze."""
    m = PlanarMap.prior(np.full(2, -0.04), np.full(2, 1.04), 0.01)
    written = jax.jit(lambda m, ranges, state: update(m, ranges, state, scanner(64, reach), PlanarConfig()))
    for state in states:
        ranges = scan(state[None], MAZE.rectangles, 64)[0]
        m = written(m, jnp.asarray(ranges, jnp.float32), jnp.asarray(state, jnp.float32))
    return m


@pytest.fixture(scope="module")
def known() -> PlanarMap:
    """Return the map of the left half of the maze, all of which was passed."""
    places = MAZE.space.sample(np.random.default_rng(0), 900)
    left = places[places[:, 0] < 0.5]
    return mapped(np.column_stack([left, np.zeros(len(left))]), reach=0.05)


def standing(places: np.ndarray, times: int = 1) -> jax.Array:
    """Return draws of poses at places, a millimetre apart."""
    off = 0.001 * jax.random.normal(jax.random.key(7), (SMALL.draws, 1, 3))
    at = jnp.asarray(np.column_stack([places, np.zeros(len(places))]), jnp.float32)
    return jnp.broadcast_to(at[:, None, None] + off, (len(places), SMALL.draws, times, 3))


def test_unknown_space_is_worth_more_than_known_walls(known):
    model = OccupancyScans(known, scanner(16, 0.05), 0.005, free_path=5.0)
    inside = MAZE.space.sample(np.random.default_rng(1), 60)
    old = inside[inside[:, 0] < 0.35][:8]
    new = inside[inside[:, 0] > 0.65][:8]
    nats = np.asarray(scan_information(jax.random.key(0), model, standing(np.concatenate([old, new])), SMALL))
    assert np.isfinite(nats).all()
    assert nats[len(old) :].min() > nats[: len(old)].max()
    assert abs(nats[: len(old)].mean()) < 0.3 * nats[len(old) :].mean()


def test_what_is_seen_twice_counts_once(known):
    """Standing still for four scans is worth little more than one of them, and turning meanwhile adds nothing."""
    model = OccupancyScans(known, scanner(16, 0.05), 0.005, free_path=5.0)
    place = np.array([[0.8, 0.5]])
    once, often = (
        float(scan_information(jax.random.key(0), model, standing(place, times), SMALL)[0]) for times in (1, 4)
    )
    assert once < often < 2.5 * once
    turned = standing(place, 4).at[..., 2].add(jnp.array([0.0, 0.5, 1.0, 1.5]))
    again = scan_information(jax.random.key(0), model, facing_x(turned), SMALL)[0]
    np.testing.assert_allclose(float(again), often, rtol=0.1)


def test_refined_sequences_are_safer_and_never_worse(known):
    m = mapped(np.array([[0.1, 0.1, 0.0], [0.3, 0.3, 0.0], [0.5, 0.5, 0.0], [0.1, 0.5, 0.0]]))
    model, config = OccupancyScans(m, scanner(16, 0.1), 0.005), ControlSearchConfig(candidates=16, rounds=8)
    belief, limits = planar_belief(jnp.array([0.1, 0.1, 0.5]), 1e-6 * jnp.eye(3)), jnp.asarray(LIMITS)
    turns = random_turns(jax.random.key(1), config, LIMITS[0])
    refined = jax.jit(lambda: refine(jax.random.key(2), model, TRANSITION, belief, turns, config, limits, 0.2))
    better, least = refined()
    key = jax.random.split(jax.random.key(2))[0]
    first, last = (
        penalty(model, trajectories(key, TRANSITION, belief, controls_of(u, config, limits), config.draws, 0.2), config)
        for u in (turns, better)
    )
    np.testing.assert_allclose(last, least, rtol=1e-3, atol=1e-3)
    assert bool(jnp.all(last <= first + 1e-3))
    assert float(last.mean()) < 0.7 * float(first.mean())


def test_controls_keep_the_limits():
    config = ControlSearchConfig()
    controls = controls_of(random_turns(jax.random.key(0), config, LIMITS[0]), config, jnp.asarray(LIMITS))
    assert controls.shape == (config.candidates, config.horizon, 3)
    assert float(jnp.abs(controls[..., 0]).max()) <= LIMITS[0] + 1e-6
    assert float(controls[..., 2].min()) >= 0.0 and float(controls[..., 2].max()) <= LIMITS[1] + 1e-6


def test_roads_keep_away_from_walls():
    """Every point of a path has room; its length is that of the distance, and places are spread over free space."""
    places = MAZE.space.sample(np.random.default_rng(0), 200)
    m = mapped(np.column_stack([places, np.zeros(len(places))]))
    roads = PlaneRoads.of(m, np.array([0.1, 0.1]), 0.02)
    goal = np.array([0.9, 0.9])
    path = roads.path_to(goal)
    np.testing.assert_allclose(path[-1], goal, atol=0.006)
    assert min(clearance(x, y, MAZE.rectangles) for x, y in path) > 0.0125
    length = np.hypot(*np.diff(path, axis=0).T).sum()
    np.testing.assert_allclose(length, roads.lengths_to(goal[None])[0], atol=0.03)
    spread = roads.places(0.1)
    assert 70 <= len(spread) <= 100
    assert len(roads.path_to(np.array([-0.03, -0.03]))) == 0


@pytest.mark.slow
def test_the_choice_leads_to_what_is_unknown(known):
    """From the far end of the known half a path is chosen, and it ends where something is to be learned."""
    places = MAZE.space.sample(np.random.default_rng(0), 200)
    seen = mapped(np.column_stack([places, np.zeros(len(places))]))
    roads = PlaneRoads.of(seen, np.array([0.1, 0.5]), 0.02)
    belief = planar_belief(jnp.array([0.1, 0.5, 0.0]), 1e-6 * jnp.eye(3))
    models = [OccupancyScans(m, scanner(16, 0.05), 0.005, free_path=5.0) for m in (known, seen)]
    config = PlaneChoiceConfig(ControlSearchConfig(candidates=6, rounds=2), SMALL, paths=6)
    found = choose(jax.random.key(0), *models, TRANSITION, belief, roads, LIMITS, 0.2, config)
    assert found is not None and found.path is not None and found.controls is None
    assert found.path[-1, 0] > 0.4 and found.nats > 5.0
    again = choose(jax.random.key(0), *models, TRANSITION, belief, roads, LIMITS, 0.2, config)
    assert again is not None and again.path is not None
    np.testing.assert_array_equal(again.path, found.path)
    alone = PlaneChoiceConfig(ControlSearchConfig(candidates=6, rounds=2), SMALL, paths=0)
    published = choose(jax.random.key(0), *models, TRANSITION, belief, roads, LIMITS, 0.2, alone)
    assert published is None or (published.controls is not None and published.path is None)


def test_bad_configurations_are_refused(known):
    with pytest.raises(InputError, match="draws: expected more than 3, not 3"):
        SampledInformationConfig(draws=3)
    with pytest.raises(InputError, match="maps: expected 1 to 10, not 11"):
        SampledInformationConfig(draws=10, maps=11)
    with pytest.raises(InputError, match="fineness: expected above 0 m"):
        SampledInformationConfig(fineness=0.0)
    with pytest.raises(InputError, match="legs: expected at least 1"):
        ControlSearchConfig(legs=0)
    model = OccupancyScans(known, scanner(8, 0.05), 0.005)
    with pytest.raises(InputError, match="10 draws a candidate; found 4"):
        scan_information(jax.random.key(0), model, jnp.zeros((1, 4, 1, 3)), SMALL)
