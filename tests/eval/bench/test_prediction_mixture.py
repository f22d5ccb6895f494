"""Test predictions by samples: the mixture by hand, its distribution functions, the calibration of its own draws."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from tests.helpers.field_oracle import KNOWN, pixel_log_prob
from vssm_gym.eval.bench.prediction.contract import Prediction
from vssm_gym.eval.bench.prediction.mixture import SampledPrediction
from vssm_gym.eval.bench.prediction.scores import score
from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.transition import planar_belief

SCALES = EmissionScales(0.1, 0.0, 0.1, textured=0.0, outlier=0.1, rgb_outlier=0.2, miss=0.3, empty_miss=0.9)
ANY_DEPTH = stats.fisk(3.0, scale=float(SCALES.outlier_depth))  # of a reading that is not the predicted surface's
BELIEF = planar_belief(jnp.array([1.0, 2.0, 0.5]), jnp.diag(jnp.array([0.1, 0.2, 0.3]) ** 2))


def samples(depth: np.ndarray, rgb: np.ndarray) -> RGBD:
    """Return images ``(k, 1, n)`` of observed surfaces; a depth of 0 is no surface."""
    hit = jnp.asarray(depth > 0.0)
    return jax.tree.map(
        lambda a: a[:, None],
        RGBD(jnp.asarray(depth, jnp.float32), jnp.asarray(rgb * (depth > 0)[..., None], jnp.float32), hit, hit),
    )


def prediction(depth: np.ndarray, rgb: np.ndarray, poses: int = 200) -> SampledPrediction:
    return SampledPrediction(samples(depth, rgb), SCALES, BELIEF.sample(jax.random.key(0), poses), BELIEF)


def test_the_density_is_the_mean_over_samples() -> None:
    """Depth and colour together: their mixture is not the product of their mixtures."""
    rng, n = np.random.default_rng(0), 6
    depth, rgb = rng.uniform(1.0, 1.3, (3, n)), rng.uniform(0.4, 0.6, (3, n, 3))
    seen, light = np.r_[rng.uniform(1.0, 1.3, n - 1), 0.0], rng.uniform(0.4, 0.6, (n, 3))
    each = [pixel_log_prob(seen, light, d, c, np.full(n, KNOWN), SCALES) for d, c in zip(depth, rgb, strict=True)]
    image = jax.tree.map(lambda a: a[0], samples(seen[None], light[None]))
    log_p = prediction(depth, rgb).image_log_prob(image)
    np.testing.assert_allclose(np.asarray(log_p.total)[0], np.log(np.mean(np.exp(each), axis=0)), rtol=1e-3, atol=1e-3)
    assert float(log_p.rgb[0, -1]) == 0.0


def test_distribution_functions_are_conditional_on_a_reading() -> None:
    """One sample sees a surface at 2 m, the other none, whose reading is anywhere and rare: 0.7 against 0.1."""
    both = prediction(np.array([[2.0], [0.0]]), np.full((2, 1, 3), 0.5))
    below = np.asarray(both.depth_cdf(jnp.array([[[1.0]], [[4.0]]])))[:, 0, 0]
    anywhere = ANY_DEPTH.cdf([1.0, 4.0]) / ANY_DEPTH.cdf(MAX_DEPTH)
    expected = (0.7 * (0.9 * np.array([0.0, 1.0]) + 0.1 * anywhere) + 0.1 * anywhere) / 0.8
    np.testing.assert_allclose(below, expected, atol=1e-4)
    light = np.asarray(both.rgb_cdf(jnp.full((1, 1, 3), 0.5)))
    np.testing.assert_allclose(light, 0.5, atol=1e-5)


def test_draws_from_a_prediction_are_calibrated() -> None:
    """Pixels drawn from the mixture have a uniform PIT in depth and colour; so has a pose drawn from the belief."""
    rng, n, k = np.random.default_rng(3), 4000, 5
    depth, rgb = rng.uniform(1.5, 3.0, (k, n)), rng.uniform(0.3, 0.7, (k, n, 3))
    which = rng.integers(k, size=n)
    at = which, np.arange(n)
    other = ANY_DEPTH.ppf(rng.uniform(0, ANY_DEPTH.cdf(MAX_DEPTH), n))
    seen = np.where(rng.random(n) < SCALES.outlier, other, rng.laplace(depth[at], 0.1))
    light = np.where(rng.random((n, 1)) < SCALES.rgb_outlier, rng.random((n, 3)), rng.normal(rgb[at], 0.1))
    inside = ((light > 0) & (light < 1)).all(1)
    seen, light = seen * inside, np.rint(light * 255) / 255
    given = prediction(depth, rgb)
    image = jax.tree.map(lambda a: a[0], samples(seen[None], light[None]))
    poses = np.asarray(BELIEF.sample(jax.random.key(7), 300), float)
    found = [score(given, image, pose, rng) for pose in poses[:1]]
    assert stats.kstest(found[0].depth_pit, "uniform").pvalue > 1e-3
    assert stats.kstest(found[0].rgb_pit[::3], "uniform").pvalue > 1e-3
    assert found[0].depth_crps.shape == (inside.sum(),)


def test_the_contract_is_met() -> None:
    given = prediction(np.full((2, 3), 2.0), np.full((2, 3, 3), 0.5))
    assert isinstance(given, Prediction)
    pose = jnp.array([1.1, 2.0, 0.4])
    assert float(given.pose_log_prob(pose)) == float(BELIEF.log_prob(pose))
