"""Test the fit of emission scales: scales that pixels were drawn with, and what no pixel tells about."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import fisk

from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.inference.mapping.scale_fit import SMALLEST_SHARE, PixelPairs, fit
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales, log_prob

DRAWN = EmissionScales(0.02, 0.004, 0.01, 0.08, 0.4, 0.08, 0.6, 1.8, 0.15, 0.7, 0.1, 0.3, 0.6)
N = 200, 200  # pixels


def pairs(scales: EmissionScales, known: float = 0.6, hit: float = 0.8) -> PixelPairs:
    """Draw predictions, and images from the density; ``known`` and ``hit`` are shares of the pixels."""
    rng = np.random.default_rng(0)
    u = rng.random(N)
    kind = np.where(u < known, 0, np.where(u < hit, 1, 2))
    pick = lambda *values: np.array([float(v) for v in values])[kind]
    location, light = rng.uniform(0.5, 6.0, N), rng.uniform(0.3, 0.7, (*N, 3))
    outlier = rng.random(N) < pick(scales.outlier, scales.guess_outlier, 1.0)
    depth = rng.laplace(location, np.asarray(scales.depth_at(jnp.asarray(location))))
    other = fisk(3.0, scale=float(scales.outlier_depth))
    any_depth = other.ppf(rng.uniform(1e-6, other.cdf(MAX_DEPTH), N))
    depth = np.where(outlier, any_depth, np.clip(depth, 1e-3, MAX_DEPTH))
    stray = rng.random(N) < pick(scales.rgb_outlier, scales.guess_rgb_outlier, 1.0)
    rough = rng.random(N) < scales.textured
    noise = rng.normal(0.0, np.where(rough, scales.textured_rgb, scales.rgb)[..., None], (*N, 3))
    rgb = np.where(stray[..., None], rng.random((*N, 3)), np.clip(light + noise, 0, 1))
    read = rng.random(N) >= pick(scales.miss, scales.guess_miss, scales.empty_miss)
    f32 = lambda a: jnp.asarray(a, jnp.float32)
    image = RGBD(f32(depth * read), f32(rgb), jnp.asarray(read), jnp.asarray(read))
    on = kind < 2
    predicted = RGBD(f32(location * on), f32(light * on[..., None]), jnp.asarray(on), jnp.asarray(kind == 0))
    return PixelPairs.of(image, predicted)


def test_the_scales_that_pixels_were_drawn_with_are_found() -> None:
    found = fit(pairs(DRAWN))
    for name, drawn in vars(DRAWN).items():
        assert float(getattr(found, name)) == pytest.approx(drawn, rel=0.12), name


def test_no_other_scales_explain_the_pixels_better() -> None:
    given = pairs(DRAWN)
    of = lambda scales: float(log_prob(given.image, given.predicted, scales).total.mean())
    best = of(fit(given))
    assert best > of(DRAWN)
    assert best > of(EmissionScales()) + 0.1


def test_what_no_pixel_tells_about_stays_and_what_never_happened_stays_possible() -> None:
    """All pixels are observed surfaces, all have a reading, and none is an outlier."""
    sure = EmissionScales(0.02, 0.0, 0.01, 0.08, outlier=0.0, rgb_outlier=0.0, miss=0.0)
    found, start = fit(pairs(sure, known=1.0, hit=1.0)), EmissionScales()
    for name in ("guess_outlier", "guess_rgb_outlier", "guess_miss", "empty_miss"):
        assert float(getattr(found, name)) == pytest.approx(float(getattr(start, name)), rel=1e-3)
    assert float(found.miss) == pytest.approx(SMALLEST_SHARE, rel=1e-3)
    assert float(found.outlier) < 0.005


def test_drawn_pixels_are_some_of_all() -> None:
    every = [pairs(DRAWN), pairs(DRAWN, known=0.1)]
    few = PixelPairs.drawn(every, 500)
    again = PixelPairs.drawn(every, 500)
    assert few.image.rgb.shape == (500, 3)
    assert few.depth_std.shape == (500,)
    assert all((np.asarray(a) == np.asarray(b)).all() for a, b in zip(*map(jax.tree.leaves, (few, again)), strict=True))
    assert PixelPairs.drawn(every).image.depth.shape == (60_000,)
