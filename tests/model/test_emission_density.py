"""Test the emission's density: a float64 oracle, its integral, its distribution function, poses that see nothing."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import fisk

from tests.helpers.analytic_room import camera_pose
from tests.helpers.field_oracle import EMPTY, GUESSED, KNOWN, pixel_log_prob
from tests.helpers.localisation_room import CAMERA, ROOM, known_map
from vssm_gym.model.emission import MAX_DEPTH, RGBD, render
from vssm_gym.model.emission_density import EmissionScales, depth_cdf, log_prob, rgb_cdf

log_prob_jit, depth_cdf_jit, rgb_cdf_jit = (jax.jit(f) for f in (log_prob, depth_cdf, rgb_cdf))
NODES = 4001

share = st.floats(1e-6, 0.99)
scales = st.builds(
    EmissionScales,
    depth=st.floats(0.003, 0.3),
    growth=st.floats(0.0, 0.02),
    rgb=st.floats(0.005, 0.5),
    textured_rgb=st.floats(0.005, 0.5),
    textured=share,
    outlier=share,
    guess_outlier=share,
    outlier_depth=st.floats(0.3, 8.0),
    rgb_outlier=share,
    guess_rgb_outlier=share,
    miss=share,
    guess_miss=share,
    empty_miss=share,
)
kinds, ranges = st.sampled_from((KNOWN, GUESSED, EMPTY)), st.floats(4.5, 20.0)
depths, channels = st.floats(0.05, 4.4), st.floats(0.0, 1.0)


def f32(a) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def pixels(depth: np.ndarray, rgb: np.ndarray) -> RGBD:
    """Return readings ``(n,)`` as a camera's image; a depth of 0 is no reading."""
    return RGBD(f32(depth)[None], f32(rgb)[None], f32(depth)[None] > 0.0, f32(depth)[None] > 0.0)


def prediction(depth: float, rgb: np.ndarray, kind: int, count: int) -> RGBD:
    """Return one prediction at ``count`` pixels; where no surface is predicted, depth and colour are 0."""
    hit = kind != EMPTY
    mask = lambda value: jnp.full((1, count), value)
    colour = jnp.broadcast_to(f32(rgb) * hit, (1, count, 3))
    return RGBD(mask(f32(depth * hit)), colour, mask(hit), mask(kind == KNOWN))


def around(centre: float, width: float, end: float) -> np.ndarray:
    """Return nodes on ``[0, end]``, dense around the centre."""
    t = np.linspace(-1.0, 1.0, NODES - 2)
    offsets = np.sign(t) * width * np.expm1(np.abs(t) * np.log1p(end / width))
    return np.sort(np.clip(np.r_[0.0, centre + offsets, end], 0.0, end))


@given(scales, kinds, depths, st.lists(channels, min_size=3, max_size=3), ranges, st.integers(0, 2**31 - 1))
def test_the_density_is_that_of_the_definition(scales, kind, location, colour, end, seed) -> None:
    """Readings near the prediction, anywhere in the range, and none, with a map's uncertainty, against float64."""
    rng, n = np.random.default_rng(seed), 12
    depth = np.r_[rng.uniform(0.01, end, 4), np.clip(location + rng.normal(0, 0.05, 4), 0.01, end), np.zeros(4)]
    rgb = np.r_[rng.uniform(size=(6, 3)), np.clip(colour + rng.normal(0, 0.05, (6, 3)), 0, 1)]
    stds = rng.uniform(0.0, 0.1, 2)
    predicted = prediction(location, np.array(colour), kind, n)
    of_map = [jnp.where(predicted.known, f32(stds[0]), jnp.inf), jnp.full((1, n, 3), f32(stds[1]))]
    value = log_prob_jit(pixels(depth, rgb), predicted, scales, f32(end), *of_map).total
    hit = kind != EMPTY
    at = np.full(n, location * hit), np.tile(np.array(colour) * hit, (n, 1)), np.full(n, kind)
    expected = pixel_log_prob(depth, rgb, *at, scales, end, *stds)
    np.testing.assert_allclose(np.asarray(value[0], float), expected, rtol=2e-3, atol=2e-3)


@given(scales, kinds, depths, channels, ranges)
def test_the_density_integrates_to_one(scales, kind, location, colour, end) -> None:
    """No reading, and all depths of the range; the next test has colour."""
    predicted = prediction(location, np.full(3, colour), kind, NODES)
    nodes = around(location, 0.001, end)
    depth = np.r_[0.0, np.maximum(nodes[1:], 1e-6)]  # the first is no reading
    density = np.exp(
        np.asarray(log_prob_jit(pixels(depth, np.zeros((NODES, 3))), predicted, scales, f32(end)).depth[0])
    )
    assert float(density[0]) + np.trapezoid(density[1:], nodes[1:]) == pytest.approx(1.0, abs=5e-3)


@given(st.floats(0.1, 0.5), st.floats(0.0, 1.0), st.lists(channels, min_size=3, max_size=3))
@settings(max_examples=20)
def test_the_colour_integrates_to_one(scale, rgb_outlier, location) -> None:
    n = 41
    axis = (np.arange(n) + 0.5) / n
    rgb = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    scales = EmissionScales(rgb=scale, textured_rgb=0.4, textured=0.3, rgb_outlier=rgb_outlier)
    predicted = prediction(2.0, np.array(location), KNOWN, n**3)
    value = log_prob_jit(pixels(np.full(n**3, 2.0), rgb), predicted, scales, f32(MAX_DEPTH)).rgb[0]
    assert np.exp(np.asarray(value, float)).mean() == pytest.approx(1.0, abs=1e-2)


@given(scales, kinds, depths, channels, ranges)
def test_distribution_functions_are_integrals_of_densities(scales, kind, location, colour, end) -> None:
    predicted = prediction(location, np.full(3, colour), kind, NODES)
    nodes = around(location, 0.001, end)
    readings = pixels(np.maximum(nodes, 1e-6), np.full((NODES, 3), colour))
    log_p = np.asarray(log_prob_jit(readings, predicted, scales, f32(end)).depth[0], float)
    miss = [scales.miss, scales.guess_miss, scales.empty_miss][kind]
    density = np.exp(log_p - np.log1p(-miss))
    integral = np.r_[0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(nodes))]
    cdf = np.asarray(depth_cdf_jit(f32(nodes)[None], predicted, scales, f32(end))[0], float)
    np.testing.assert_allclose(cdf, integral, atol=5e-3)
    assert cdf[0] == pytest.approx(0.0, abs=1e-6)
    assert cdf[-1] == pytest.approx(1.0, abs=1e-5)


def test_the_distribution_of_a_channel_is_a_marginal_of_the_density() -> None:
    """The share of uniform draws below a value, weighted by the density."""
    rng, n, location = np.random.default_rng(0), 200_000, np.array([0.2, 0.5, 0.9])
    scales, predicted = (
        EmissionScales(rgb=0.2, textured_rgb=0.5, textured=0.4, rgb_outlier=0.3),
        prediction(2.0, location, KNOWN, n),
    )
    rgb = rng.uniform(size=(n, 3))
    weight = np.exp(
        np.asarray(log_prob_jit(pixels(np.full(n, 2.0), rgb), predicted, scales, f32(MAX_DEPTH)).rgb[0], float)
    )
    for value in (0.1, 0.5, 0.85):
        cdf = rgb_cdf(jnp.full((1, 1, 3), value), prediction(2.0, location, KNOWN, 1), scales)[0, 0]
        np.testing.assert_allclose(np.asarray(cdf), np.mean(weight[:, None] * (rgb < value), axis=0), atol=0.01)


def test_readings_beyond_the_range_count_as_none() -> None:
    predicted = prediction(3.0, np.full(3, 0.5), KNOWN, 2)
    value = log_prob_jit(pixels(np.array([5.0, 0.0]), np.full((2, 3), 0.5)), predicted, EmissionScales(), f32(4.0))
    np.testing.assert_allclose(np.asarray(value.depth), np.log(EmissionScales().miss), rtol=1e-5)
    assert not np.asarray(value.rgb).any()


def test_a_camera_that_sees_nothing_is_less_likely_than_the_true_pose() -> None:
    """Not one pixel is predicted there, whose sum over pixels that both have would be 0: more than any other pose's."""
    T = camera_pose((-1.0, 0.0, 1.0), 0.3)
    image, m = ROOM.image(T, CAMERA), known_map()
    away = np.array(T)
    away[2, 3] += 20.0  # above the map, where no ray meets it
    at = lambda T: render(m, f32(T), CAMERA)
    assert not bool(at(away).hit.any())
    of = lambda predicted: float(log_prob_jit(image, predicted, EmissionScales(), f32(MAX_DEPTH)).total.mean())
    assert of(at(T)) > of(at(away)) + 2.0
    depth = np.asarray(image.depth, float)[np.asarray(image.hit)]
    other = fisk(3.0, scale=float(EmissionScales().outlier_depth))
    expected = np.log((1.0 - EmissionScales().empty_miss) / other.cdf(MAX_DEPTH)) + other.logpdf(depth).mean()
    assert of(at(away)) == pytest.approx(expected, rel=1e-3)


def test_gradients_of_scales_and_prediction_are_finite_where_they_meet() -> None:
    """At a residual of 0, at shares of 0 and without a reading."""
    predicted = prediction(2.0, np.full(3, 0.5), KNOWN, 3)
    image = pixels(np.array([2.0, 0.0, 7.0]), np.full((3, 3), 0.5))
    for scales in (EmissionScales(), EmissionScales(outlier=0.0, rgb_outlier=0.0, miss=0.0)):
        scales = jax.tree.map(f32, scales)
        total = lambda scales, depth: log_prob(
            image, eqx.tree_at(lambda p: p.depth, predicted, depth), scales
        ).total.sum()
        for leaf in jax.tree.leaves(jax.grad(total, argnums=(0, 1))(scales, predicted.depth)):
            assert np.isfinite(np.asarray(leaf)).all()


def test_the_range_law_is_that_of_triangulation() -> None:
    scales = EmissionScales(depth=0.01, growth=0.002)
    np.testing.assert_allclose(np.asarray(scales.depth_at(f32([0.0, 1.0, 3.0]))), [0.01, 0.012, 0.028], rtol=1e-6)
