"""Test that covariances are right on average: NEES of every filter over noisy drives through one room."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from tests.helpers.localisation_room import GRID, known_map
from tests.inference.test_planar_prism import DARK, EXECUTION, RIG, ROBOT, START, see
from vssm_gym.envs.robots import execute
from vssm_gym.inference.registry import FILTERS
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief

DRIVES, STEPS = 8, 24
MOTION = Planar(MotionNoise(EXECUTION.turn, EXECUTION.step))
LEAST, MOST = 0.15, 2.5  # mean NEES / 3; a tracker allows for errors of its map, which here is exact


def noisy(image: RGBD, rng: np.random.Generator) -> RGBD:
    """Add the noise of a Kinect at this range, to depth alone."""
    depth = np.asarray(image.depth) * (1.0 + 0.003 * rng.standard_normal(image.depth.shape))
    return RGBD.from_camera(np.rint(np.asarray(image.rgb) * 255).astype(np.uint8), depth)


def nees(name: str, seed: int, seen: Callable[[int], bool]) -> list[float]:
    """Drive a noisy circle and return the NEES of each step."""
    rng, planar, entry = np.random.default_rng(seed), START, FILTERS[name]
    tracker = entry.make(RIG, MOTION)
    prior = Posterior(
        planar_belief(jnp.asarray(START, jnp.float32), 1e-6 * jnp.eye(3)),
        known_map() if entry.needs_map else VoxelMap.prior(*GRID) if entry.maps else None,
    )
    state, found = tracker.init(prior, noisy(see(START), rng), jax.random.key(seed)), []
    for k in range(STEPS):
        command = np.array([0.18, rng.uniform(-0.08, 0.08), 0.08])
        planar = execute(planar, command, EXECUTION, rng)
        image = noisy(see(planar), rng) if seen(k) else DARK
        state, info = tracker.step(state, jnp.asarray(command, jnp.float32), image, ROBOT.dt)
        belief = info.belief
        off = np.asarray(belief.manifold.error(belief.mean, jnp.asarray(planar, jnp.float32)), float)
        found.append(off @ np.linalg.solve(np.asarray(belief.covariance, float), off))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name", ["prism", "tracker", "frames", "dead_reckoning"])
def test_the_mean_nees_of_a_filter_is_near_its_dimension(name: str) -> None:
    """Eight drives, the middle third in the dark, where only the commands are known."""
    found = np.array([nees(name, seed, lambda k: not 8 <= k < 16) for seed in range(DRIVES)])
    assert LEAST < found.mean() / 3 < MOST
    assert np.mean(found <= chi2.ppf(0.95, 3)) >= 0.85
