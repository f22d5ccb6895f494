"""Test the evidence lower bound: each term against quadrature in float64, and the bound against the evidence.

The toy is a robot on a line that looks along it with a camera of one pixel, at a wall between two uncertain cells.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from tests.helpers.field_oracle import EMPTY, KNOWN, pixel_log_prob
from tests.inference.smoothing.line_motion import LINE, LineMotion, dense_path
from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.smoothing.elbo import (
    Elbo,
    VariationalPosterior,
    elbo,
    every_pixel,
    log_prob_path,
    map_divergence,
)
from vssm_gym.inference.smoothing.families import Chain, MeanField
from vssm_gym.maps.block_table import BlockTable
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.spatial_model import SpatialModel
from vssm_gym.model.transition.belief import GaussianBelief

FORWARD = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
VOXEL, RANGE, TIME = 0.5, 4.1, 3
SCALES = EmissionScales(depth=0.1, growth=0.001, rgb=0.05, textured_rgb=0.1)
DT, CONTROLS = np.array([0.5, 0.4]), np.array([[0.2], [-0.1]])
START = GaussianBelief(jnp.array([0.6, 0.5]), jnp.diag(jnp.array([0.15, 0.2]) ** 2), LINE)
MOTION = LineMotion((0.05, 0.1))
READINGS = np.array([2.25, 1.8, 0.0])  # m; the last pixel has none
KEYS, SAMPLES = 10, 400  # of the estimates that are compared with quadrature


def f32(a) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


# --- the toy

PROFILE = np.array([-0.5, -0.5, -0.5, -0.5, -0.5, -0.25, 0.25, 0.5])  # m, occupancy of the cells along the line
UNCERTAIN = (5, 6)  # cells before and behind the surface
STD, PRIOR_STD = (0.05, 0.07), (0.15, 0.15)  # m, of these two


def line_map(std: tuple[float, float]) -> VoxelMap:
    """Return a block whose cells depend on x alone; two of them, on the camera's line, are uncertain."""
    m = VoxelMap.prior((0.0, -1.5, -1.5), VOXEL, (8, 8, 8))
    precision = np.full((8, 8, 8), 1e8)
    precision[UNCERTAIN, 3, 3] = np.array(std) ** -2.0
    cells = np.broadcast_to(PROFILE[:, None, None], (8, 8, 8))
    arrays = (m.blocked(f32(cells)), m.blocked(f32(precision)), jnp.full_like(m.colour, 0.5))
    return eqx.tree_at(
        lambda m: (m.occupancy, m.occupancy_precision, m.colour, m.colour_precision),
        m,
        (*arrays, jnp.full_like(m.colour_precision, 1e8)),
    )


MODEL = SpatialModel(
    MOTION, line_map(PRIOR_STD), Camera(1, 1, 1.0, 1.0, 0.0, 0.0), f32(FORWARD), SCALES, max_depth=RANGE
)
DEPTH = f32(READINGS[:, None, None])
IMAGES = RGBD(DEPTH[0], jnp.full((1, 1, 3), 0.5), DEPTH[0] > 0.0, DEPTH[0] > 0.0)
IMAGES = eqx.tree_at(
    lambda i: (i.depth, i.rgb, i.hit, i.known), IMAGES, (DEPTH, jnp.full((TIME, 1, 1, 3), 0.5), DEPTH > 0, DEPTH > 0)
)


def line_posterior() -> VariationalPosterior:
    """Return a correlated trajectory and the map; neither is the exact posterior."""
    rng = np.random.default_rng(0)
    means = np.array([[0.55, 0.45], [0.85, 0.6], [1.1, 0.5]])
    chain = Chain.around(f32(means), f32(np.tile([0.06, 0.1], (TIME, 1))), LINE)
    blocks = f32(rng.normal(0.0, 0.4, (TIME, 2, 2))), f32(rng.normal(0.0, 0.4, (TIME - 1, 2, 2)))
    return VariationalPosterior(eqx.tree_at(lambda q: (q.within, q.below), chain, blocks), line_map(STD))


def dense_posterior(q: Chain) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of a chain on the line, in float64."""
    time, n = q.log_std.shape
    L, scale = np.zeros((time, n, time, n)), np.exp(-np.asarray(q.log_std, float))[:, :, None]
    for t in range(time):
        L[t, :, t] = scale[t] * (np.eye(n) + np.tril(np.asarray(q.within[t], float), -1))
        if t:
            L[t, :, t - 1] = scale[t] * np.asarray(q.below[t - 1], float)
    L = L.reshape(time * n, -1)
    return np.asarray(q.nominal + q.offset, float).reshape(-1), np.linalg.inv(L @ L.T)


def first_crossing(x: np.ndarray, before: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Return the z-depth of the first crossing, from places and the two cells; 0 where there is none."""
    e = 0.4 * VOXEL
    fixed = PROFILE.copy()
    fixed[list(UNCERTAIN)] = 0.0
    tents = [np.eye(8)[cell] for cell in UNCERTAIN]
    place, shape = VOXEL * np.arange(8), np.broadcast_shapes(x.shape, before.shape, behind.shape)
    depth, last = np.zeros(shape), None
    for k in range(1, int(RANGE / e) + 1):
        p = x + k * e
        field, a, b = (np.interp(p, place, cells) for cells in (fixed, *tents))
        now = np.where(p <= place[-1], field + a * before + b * behind, -0.001)
        if k > 1:
            held = np.minimum(last, 0.0) if k == 2 else last
            with np.errstate(invalid="ignore", divide="ignore"):
                crossing = k * e + e * now / (held - now)
            depth = np.where((depth == 0.0) & (now > 0.0), crossing, depth)
        last = np.broadcast_to(now, shape)
    return depth


def log_image(t: int, depth: np.ndarray) -> np.ndarray:
    """Return ``log p(x_t | depth of the surface)`` in float64, from a table that has the reading among its nodes."""
    nodes = np.union1d(np.linspace(0.01, RANGE, 2000), READINGS[t])
    n = len(nodes)
    rgb = np.full((n, 3), 0.5)
    table = pixel_log_prob(np.full(n, READINGS[t]), rgb, nodes, rgb, np.full(n, KNOWN), SCALES, RANGE)
    one, none = np.full((1, 3), 0.5), np.zeros((1, 3))
    empty = pixel_log_prob(READINGS[t : t + 1], one, np.zeros(1), none, np.array([EMPTY]), SCALES, RANGE)
    return np.where(depth > 0.0, np.interp(depth, nodes, table), empty)


def grid(mean: float, std: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of a normal distribution."""
    nodes = np.linspace(-5.0, 5.0, count)
    weights = np.exp(-0.5 * nodes**2)
    return mean + std * nodes, weights / weights.sum()


def along_the_line(values: tuple[float, float], count: int) -> tuple[np.ndarray, ...]:
    """Return nodes and weights of the two cells, of given standard deviations, flat."""
    (a, wa), (b, wb) = (grid(PROFILE[cell], std, count) for cell, std in zip(UNCERTAIN, values, strict=True))
    a, b = (x.reshape(-1) for x in np.meshgrid(a, b, indexing="ij"))
    return a, b, np.outer(wa, wb).reshape(-1)


def estimate(seed: int, q: VariationalPosterior) -> Elbo:
    arguments = MODEL, START, q, f32(CONTROLS), IMAGES, f32(DT), every_pixel(TIME, MODEL.camera)
    return elbo(jax.random.key(seed), *arguments, samples=SAMPLES)


@pytest.fixture(scope="module")
def estimates() -> dict[str, np.ndarray]:
    """Return estimates of each term by several keys."""
    found = [estimate(seed, line_posterior()) for seed in range(KEYS)]
    return {name: np.array([float(getattr(e, name)) for e in found]) for name in ("images", "map", "states", "total")}


def assert_mean(found: np.ndarray, expected: float, least: float = 1e-3) -> None:
    """Assert that the mean of estimates is within 4 standard errors; ``least`` is the oracle's own error."""
    error = found.std(ddof=1) / np.sqrt(len(found))
    assert abs(found.mean() - expected) < 4.0 * error + least, (found.mean(), expected, error)


# --- terms


def test_the_images_term_is_that_of_quadrature(estimates: dict[str, np.ndarray]) -> None:
    """Over the place and both cells, each image by itself."""
    mean, covariance = dense_posterior(line_posterior().states)
    a, b, of_cells = along_the_line(STD, 41)
    total = 0.0
    for t in range(TIME):
        x, of_x = grid(mean[2 * t], np.sqrt(covariance[2 * t, 2 * t]), 81)
        total += of_x @ log_image(t, first_crossing(x[:, None], a, b)) @ of_cells
    assert estimates["images"].std() > 0.0
    assert_mean(estimates["images"], total)


def test_the_states_term_is_the_divergence_of_two_dense_gaussians(estimates: dict[str, np.ndarray]) -> None:
    mean, S = dense_posterior(line_posterior().states)
    prior_mean, P = dense_path(MOTION, START, CONTROLS, DT)
    off, ratio = prior_mean - mean, np.linalg.solve(P, S)
    divergence = 0.5 * (np.trace(ratio) - len(off) - np.linalg.slogdet(ratio)[1] + off @ np.linalg.solve(P, off))
    assert_mean(estimates["states"], divergence)


def test_the_map_term_is_the_divergence_of_the_two_cells(estimates: dict[str, np.ndarray]) -> None:
    """By quadrature of each; all others are at the prior."""
    total = 0.0
    for mean, std, prior_std in zip(PROFILE[list(UNCERTAIN)], STD, PRIOR_STD, strict=True):
        o, weights = grid(mean, std, 401)
        total += weights @ (stats.norm.logpdf(o, mean, std) - stats.norm.logpdf(o, mean, prior_std))
    np.testing.assert_allclose(estimates["map"], total, rtol=1e-4)


def random_sparse_map(seed: int) -> VoxelMap:
    """Return a map with random cells in all rows, of which two blocks own one each."""
    rng = np.random.default_rng(seed)
    m = VoxelMap.prior((0.0, 0.0, 0.0), VOXEL, (16, 16, 8), slots=5)
    cells = [f32(rng.normal(size=m.occupancy.shape)), f32(rng.normal(size=m.colour.shape))]
    precisions = [f32(rng.uniform(0.1, 10.0, m.occupancy.shape)) for _ in range(2)]
    leaves = lambda m: (m.occupancy, m.colour, m.occupancy_precision, m.colour_precision, m.table)
    return eqx.tree_at(leaves, m, (*cells, *precisions, BlockTable.of(m.blocks, 5, np.array([0, 2]))))


def test_the_map_term_counts_stored_cells_of_every_channel() -> None:
    q, prior = random_sparse_map(1), random_sparse_map(2)
    total = 0.0
    for row in (1, 2):
        for name, of in (("occupancy", "occupancy_precision"), ("colour", "colour_precision")):
            (a, pa), (b, pb) = (
                (np.asarray(getattr(m, name)[row], float), np.asarray(getattr(m, of)[row], float)) for m in (q, prior)
            )
            channels = np.broadcast_to(0.5 * (np.log(pa / pb) + pb / pa - 1.0 + pb * (a - b) ** 2), a.shape)
            total += channels.sum()
    assert float(map_divergence(q, prior)) == pytest.approx(total, rel=1e-4)
    uncoloured = eqx.tree_at(lambda m: (m.colour, m.colour_precision), q, (prior.colour, prior.colour_precision))
    without = float(map_divergence(q, prior, coloured=False))
    assert without == pytest.approx(float(map_divergence(uncoloured, prior)), rel=1e-5)
    assert float(map_divergence(q, q)) == pytest.approx(0.0, abs=1e-3)


# --- bound


def test_the_bound_is_below_the_evidence(estimates: dict[str, np.ndarray]) -> None:
    """``log p(x) > L``, the evidence by quadrature over three places and two cells."""
    nodes, weights, tables = [], [], []
    mean, S = dense_path(MOTION, START, CONTROLS, DT)
    mean, S = mean[::2], S[::2, ::2]
    a, b, of_cells = along_the_line(PRIOR_STD, 25)
    for t in range(TIME):
        nodes.append(np.linspace(-5.0, 5.0, 25) * np.sqrt(S[t, t]) + mean[t])
        weights.append(nodes[t][1] - nodes[t][0])
        tables.append(np.exp(log_image(t, first_crossing(nodes[t][:, None], a, b))))
    xs = np.stack(np.meshgrid(*nodes, indexing="ij"), axis=-1)
    prior = stats.multivariate_normal(mean, S).pdf(xs) * np.prod(weights)
    evidence = np.einsum("ijk,ic,jc,kc,c->", prior, *tables, of_cells, optimize=True)
    assert prior.sum() == pytest.approx(1.0, abs=1e-3)
    bound, error = estimates["total"].mean(), estimates["total"].std(ddof=1) / np.sqrt(KEYS)
    assert bound + 4.0 * error < np.log(evidence)
    assert np.log(evidence) - bound < 10.0  # q is near the posterior


def readings(information: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean and precision of ``p(z | readings)``, and the log evidence, by one dense system."""
    mean, P = dense_path(MOTION, START, CONTROLS, DT)
    prior, H = np.linalg.inv(P), np.zeros((TIME - 1, 2 * TIME))
    H[np.arange(TIME - 1), 2 * np.arange(1, TIME)] = 1.0
    precision = prior + information * H.T @ H
    posterior = np.linalg.solve(precision, prior @ mean)
    log_evidence = 0.5 * (posterior @ precision @ posterior - mean @ prior @ mean)
    log_evidence += 0.5 * (np.linalg.slogdet(prior)[1] - np.linalg.slogdet(precision)[1])
    return posterior, precision, log_evidence


def exact(family: type[MeanField | Chain], mean: np.ndarray, precision: np.ndarray) -> MeanField | Chain:
    """Return the member that is closest to ``N(mean, precision^-1)``, in the sense of the bound."""
    states = f32(mean.reshape(TIME, 2))
    if family is MeanField:
        return MeanField.around(states, f32(np.diag(precision).reshape(TIME, 2) ** -0.5), LINE)
    root = np.linalg.cholesky(precision).reshape(TIME, 2, TIME, 2)
    t = np.arange(TIME)
    std = 1.0 / np.diagonal(root[t, :, t], axis1=1, axis2=2)
    within, below = std[:, :, None] * root[t, :, t], std[1:, :, None] * root[t[1:], :, t[:-1]]
    chain = Chain.around(states, f32(std), LINE)
    return eqx.tree_at(lambda q: (q.within, q.below), chain, (f32(within), f32(below)))


@pytest.mark.parametrize("family", [MeanField, Chain])
def test_the_bound_is_the_evidence_where_the_family_holds_the_posterior(family: type[MeanField | Chain]) -> None:
    """Places read as 0: a linear Gaussian system. Independent steps lose the logarithm of what they ignore."""
    information = 100.0
    mean, precision, log_evidence = readings(information)
    lost = 0.5 * (np.log(np.diag(precision)).sum() - np.linalg.slogdet(precision)[1]) if family is MeanField else 0.0
    model = eqx.tree_at(lambda m: m.transition, MODEL, LineMotion(MOTION.std, information))
    drawn = exact(family, mean, precision).draw(jax.random.key(0), 20_000)
    bound = drawn.entropy.sum(axis=1) + log_prob_path(model, START, drawn.states, f32(CONTROLS), f32(DT))
    assert_mean(np.asarray(bound, float), log_evidence - lost)
    assert lost == 0.0 if family is Chain else lost > 1.0
