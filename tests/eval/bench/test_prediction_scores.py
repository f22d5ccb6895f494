"""Test the scores of predictions: closed forms of the CRPS, the PIT of a prediction's own draws, scores of the pose."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from vssm_gym.eval.bench.prediction import scores
from vssm_gym.eval.bench.prediction.rows import PIT_BINS, row_of
from vssm_gym.eval.bench.prediction.scores import Scores, band_share, crps, histogram, sample_crps


@given(st.floats(1.0, 7.0), st.floats(0.02, 0.5), st.floats(0.2, 7.8))
def test_the_crps_of_a_laplace_distribution(location, scale, value) -> None:
    """``|x - mu| + b exp(-|x - mu| / b) - 3 b / 4`` where the range holds nearly all of it."""
    laplace = lambda y: 0.5 - 0.5 * jnp.sign(location - y) * (1.0 - jnp.exp(-jnp.abs(location - y) / scale))
    off = abs(value - location)
    expected = off + scale * np.exp(-off / scale) - 0.75 * scale
    cut = 0.25 * scale * (np.exp(-2 * location / scale) + np.exp(-2 * (8.0 - location) / scale))  # beyond the range
    found = float(crps(laplace, jnp.array([value]), 8.0)[0])
    assert found == pytest.approx(expected - cut, rel=0.08, abs=0.03 * scale)


def test_the_crps_of_a_point_is_the_absolute_error() -> None:
    point = lambda y: (y >= 2.0).astype(jnp.float32)
    np.testing.assert_allclose(np.asarray(crps(point, jnp.array([2.01, 1.5, 5.0]), 8.0)), [0.01, 0.5, 3.0], rtol=0.1)


def test_the_crps_of_samples_is_that_of_their_distribution() -> None:
    """``sigma (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi))`` of a normal distribution."""
    rng = np.random.default_rng(0)
    for value in (-1.0, 0.1, 3.0):
        z = (value - 0.3) / 0.5
        expected = 0.5 * (z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / np.sqrt(np.pi))
        assert sample_crps(rng.normal(0.3, 0.5, 20_000), value) == pytest.approx(expected, abs=0.01)
    x = rng.normal(size=7)
    pairs = np.abs(x[:, None] - x).sum() / 42
    assert sample_crps(x, 0.4) == pytest.approx(np.abs(x - 0.4).mean() - 0.5 * pairs)


def test_the_band_and_the_histogram_of_uniform_values() -> None:
    pit = (np.arange(1000) + 0.5) / 1000
    assert band_share(pit) == pytest.approx(0.95)
    np.testing.assert_allclose(histogram(pit, 20), 1.0)
    np.testing.assert_allclose(histogram(pit**2, 4), [2.0, 0.8284, 0.6356, 0.536], atol=0.01)
    assert histogram(np.ones(3), 5)[-1] == 5.0


def test_the_errors_of_a_pose_are_those_in_the_body_frame() -> None:
    """A robot that heads along y is 0.1 m ahead of where it was predicted, and 0.2 rad to the left."""
    rng = np.random.default_rng(1)
    poses = np.array([1.0, 2.0, np.pi / 2]) + rng.normal(size=(4000, 3)) * [0.02, 0.05, 0.1]
    errors, truth = scores._pose_errors(jnp.asarray(poses, jnp.float32), jnp.array([1.0, 2.1, np.pi / 2 + 0.2]))
    np.testing.assert_allclose(truth, [0.1, -0.01, 0.2], atol=5e-3)  # an arc to the left that ends straight ahead
    np.testing.assert_allclose(errors.std(0), [0.05, 0.02, 0.1], rtol=0.05)


def test_headings_around_half_a_turn_have_a_mean() -> None:
    poses = jnp.array([[0.0, 0.0, np.pi - 0.1], [0.0, 0.0, -np.pi + 0.1]])
    errors, truth = scores._pose_errors(poses, jnp.array([0.0, 0.0, np.pi]))
    np.testing.assert_allclose(np.sort(errors[:, 2]), [-0.1, 0.1], atol=1e-5)
    np.testing.assert_allclose(truth, 0.0, atol=1e-5)


def of(depth_pit: np.ndarray, nats: float) -> Scores:
    """Return scores of one prediction with three pixels, two of them with a reading."""
    uniform = np.linspace(0.0, 1.0, 1000)
    return Scores(
        depth_nats=np.array([nats, nats, -1.0]),
        rgb_nats=np.array([1.0, 1.0, 0.0]),
        depth_crps=np.array([0.1, 0.2]),
        rgb_crps=np.array([0.01, 0.03]),
        depth_pit=depth_pit,
        rgb_pit=uniform,
        pose_nats=4.0,
        location_crps=0.02,
        heading_crps=0.1,
        pose_pit=np.array([0.1, 0.5, 0.9]),
    )


def test_a_row_by_hand() -> None:
    """Two drives of one and two predictions; the histogram of depth leaves its band, that of colour does not."""
    uniform = np.linspace(0.0, 1.0, 1000)
    row = row_of("m", 1.0, [[of(uniform**2, 2.0)], [of(uniform**2, 5.0), of(uniform**2, 5.0)]])
    assert row["nats"]["values"] == pytest.approx([(2 + 2 - 1 + 2) / 3, (5 + 5 - 1 + 2) / 3])
    assert row["nats"]["mean"] == pytest.approx(np.mean(row["nats"]["values"]))
    assert row["depth_nats"] == pytest.approx((3 + 9 + 9) / 9)
    assert row["rgb_nats"] == pytest.approx(2 / 3)
    assert row["depth_crps"] == pytest.approx(0.15)
    assert row["predictions"] == 3
    assert row["calibrated"] == {"depth": False, "rgb": True, "pose": False}
    assert {name: len(shares) for name, shares in row["pit"].items()} == PIT_BINS
