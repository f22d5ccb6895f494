"""Test the estimate of the evidence lower bound: its gradients against finite differences, its batches for bias.

A robot on a floor looks with a camera of six pixels at a slanted wall.
"""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.inference.smoothing.test_elbo import DT, FORWARD, RANGE, SCALES, TIME, VOXEL, f32
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.smoothing.elbo import Batch, Elbo, VariationalPosterior, draw_batch, elbo, every_pixel
from vssm_gym.inference.smoothing.families import Chain
from vssm_gym.inference.smoothing.parameters import Parameters
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.spatial_model import SpatialModel
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief

VIEW = Camera(3, 2, 2.0, 2.1, 1.1, 0.4)
FLOOR_STD = 0.02  # m and colour, of all cells


def floor_map(std: float) -> VoxelMap:
    """Return a block with a slanted, coloured wall; a camera at its centre looks along x."""
    rng = np.random.default_rng(3)
    m = VoxelMap.prior((0.0, -1.75, -1.75), VOXEL, (8, 8, 8))
    x, y, z = np.meshgrid(*[VOXEL * np.arange(8)] * 3, indexing="ij")
    occupancy = x - 2.6 + 0.2 * (y - 1.75) - 0.1 * (z - 1.75)
    arrays = (m.blocked(f32(occupancy)), jnp.full_like(m.occupancy_precision, std**-2))
    colour = (m.blocked(f32(rng.uniform(0.2, 0.8, (8, 8, 8, 3)))), jnp.full_like(m.colour_precision, std**-2))
    leaves = lambda m: (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision)
    return eqx.tree_at(leaves, m, (*arrays, *colour))


FLOOR = SpatialModel(
    Planar(MotionNoise(0.1, 0.05), (0.05, 0.05, 0.05)),
    floor_map(2.0 * FLOOR_STD),
    VIEW,
    f32(FORWARD),
    SCALES,
    max_depth=RANGE,
)
FLOOR_START = planar_belief(f32([0.3, 0.0, 0.0]), 0.01 * jnp.eye(3))
FLOOR_CONTROLS = f32([[0.1, 0.05, 0.2], [-0.05, 0.0, 0.2]])


def floor_images() -> RGBD:
    """Return images whose readings are 25 cm off, which keeps the kinks of the density at a distance."""
    rng = np.random.default_rng(4)
    depth = np.array([1.9, 1.7, 1.5])[:, None, None] + rng.uniform(0.0, 0.1, (TIME, 2, 3))
    read = rng.uniform(size=depth.shape) < 0.9
    image = RGBD(f32(depth[0]), f32(rng.uniform(0.2, 0.8, (2, 3, 3))), jnp.asarray(read[0]), jnp.asarray(read[0]))
    stacked = (f32(depth), f32(rng.uniform(0.2, 0.8, (TIME, 2, 3, 3))), jnp.asarray(read), jnp.asarray(read))
    return eqx.tree_at(lambda i: (i.depth, i.rgb, i.hit, i.known), image, stacked)


FLOOR_IMAGES = floor_images()


def floor_posterior() -> VariationalPosterior:
    rng = np.random.default_rng(5)
    states = f32([[0.32, 0.02, 0.02], [0.5, 0.03, 0.1], [0.7, 0.05, 0.06]])
    chain = Chain.around(states, jnp.full((TIME, 3), 0.03), FLOOR.transition.manifold)
    blocks = f32(rng.normal(0.0, 0.3, (TIME, 3, 3))), f32(rng.normal(0.0, 0.3, (TIME - 1, 3, 3)))
    return VariationalPosterior(eqx.tree_at(lambda q: (q.within, q.below), chain, blocks), floor_map(FLOOR_STD))


def floor_elbo(parameters: Parameters, batch: Batch) -> Elbo:
    q, model = parameters.posterior(FLOOR.m), parameters.model(FLOOR)
    arguments = model, FLOOR_START, q, FLOOR_CONTROLS, FLOOR_IMAGES, f32(DT), batch
    return elbo(jax.random.key(1), *arguments, samples=2)


PARTS = {
    "offsets": lambda p: [p.states.offset],
    "log stds of states": lambda p: [p.states.log_std],
    "correlations": lambda p: [p.states.within, p.states.below],
    "occupancy": lambda p: [p.occupancy],
    "log stds of occupancy": lambda p: [p.log_occupancy_std],
    "colour": lambda p: [p.colour],
    "log stds of colour": lambda p: [p.log_colour_std],
    "scales": lambda p: jax.tree.leaves(p.log_scales),
    "intrinsics": lambda p: jax.tree.leaves(p.intrinsics),
}


@pytest.fixture(scope="module")
def sloped() -> tuple[Parameters, Parameters]:
    """Return parameters, and the gradient of the bound by them."""
    parameters = Parameters.of(floor_posterior(), FLOOR)
    batch = every_pixel(TIME, VIEW)
    return parameters, jax.jit(jax.grad(lambda p: floor_elbo(p, batch).total))(parameters)


@pytest.mark.parametrize("part", PARTS)
def test_gradients_are_finite_differences_of_the_same_estimate(
    sloped: tuple[Parameters, Parameters], part: str
) -> None:
    """With common random numbers, along the gradient and a random direction, by 0.1 nats."""
    parameters, gradient = sloped
    rng = np.random.default_rng(6)
    slope = [np.asarray(g, float) for g in PARTS[part](gradient)]
    length = np.sqrt(sum((g**2).sum() for g in slope))
    assert length > 1e-2
    random = [rng.normal(size=g.shape) for g in slope]
    spread = np.sqrt(sum((r**2).sum() for r in random))
    direction = [g / length + 0.3 * r / spread for g, r in zip(slope, random, strict=True)]
    expected = sum((g * d).sum() for g, d in zip(slope, direction, strict=True))
    h = 0.05 / expected

    def moved(by: float) -> float:
        new = [leaf + f32(by * d) for leaf, d in zip(PARTS[part](parameters), direction, strict=True)]
        terms = floor_elbo(eqx.tree_at(PARTS[part], parameters, new), every_pixel(TIME, VIEW))
        return float(terms.images) - float(terms.map) - float(terms.states)  # in float64

    assert (moved(h) - moved(-h)) / (2.0 * h) == pytest.approx(expected, rel=0.03)


def test_parameters_give_back_posterior_and_model(sloped: tuple[Parameters, Parameters]) -> None:
    parameters, _ = sloped
    q, model = floor_posterior(), parameters.model(FLOOR)
    np.testing.assert_allclose(parameters.posterior(FLOOR.m).m.occupancy_precision, q.m.occupancy_precision, rtol=1e-5)
    np.testing.assert_array_equal(parameters.posterior(FLOOR.m).m.colour, q.m.colour)
    np.testing.assert_allclose(model.scales.textured_rgb, SCALES.textured_rgb, rtol=1e-6)
    assert float(model.camera.fy) == pytest.approx(2.1)


def test_batches_are_unbiased() -> None:
    """The average over all chunks of two steps and all choices of one pixel is the sum over all pixels.

    The posterior is certain, so that the estimate depends on the batch alone.
    """
    certain = Parameters.of(floor_posterior(), FLOOR)
    logs = lambda p: (p.states.log_std, p.log_occupancy_std, p.log_colour_std)
    certain = eqx.tree_at(logs, certain, tuple(jnp.full_like(a, -14.0) for a in logs(certain)))
    every = float(floor_elbo(certain, every_pixel(TIME, VIEW)).images)
    found = []
    for first, *pixels in product(range(TIME), range(6), range(6)):
        batch = Batch(jnp.array([first, (first + 1) % TIME]), jnp.array(pixels)[:, None])
        found.append(float(floor_elbo(certain, batch).images))
    assert np.mean(found) == pytest.approx(every, rel=1e-4)
    assert np.std(found) > 1.0


def test_batches_are_chunks_and_equally_likely() -> None:
    keys = jax.random.split(jax.random.key(2), 3000)
    drawn = jax.vmap(lambda key: draw_batch(key, 7, VIEW, 2, 3, 4))(keys)
    assert drawn.step.shape == (3000, 6) and drawn.pixels.shape == (3000, 6, 4)
    chunks = np.asarray(drawn.step).reshape(-1, 3)
    np.testing.assert_array_equal((chunks[:, 1:] - chunks[:, :-1]) % 7, 1)
    for values, count in ((chunks[:, 0], 7), (chunks[:, 2], 7), (np.asarray(drawn.pixels), 6)):
        assert stats.chisquare(np.bincount(values.reshape(-1), minlength=count)).pvalue > 1e-3
