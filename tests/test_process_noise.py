"""Adaptive process noise: what level a hand of known unsteadiness is given."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.inference import process_noise
from vssm_gym.inference.process_noise import CAUTION, FLOOR, TIME
from vssm_gym.transition.rigid import RigidNoise

NOISE = RigidNoise(0.15, 0.01, 0.3, 0.01)


def innovations(rng: np.random.Generator, std: tuple[float, float], dt: float, n: int) -> np.ndarray:
    """Of a hand whose noise is ``std`` of the configured one, drawn by its definition."""
    pose, velocity = (np.asarray(v, float) for v in NOISE.variances(dt))
    return rng.standard_normal((n, 6)) * np.sqrt(pose + velocity * dt**2) * np.repeat(std, 3)


@pytest.mark.parametrize("dt", [1 / 30, 0.1, 0.5])
@pytest.mark.parametrize("std", [(0.05, 0.3), (0.3, 0.5), (0.4, 0.02)])
def test_the_level_is_the_hands_own_times_a_margin(std: tuple[float, float], dt: float) -> None:
    """Mean over a long time: ``(c s)^2``, or the floor; translation and rotation apart from each other."""
    level, seen = process_noise.full(), []
    for e in innovations(np.random.default_rng(0), std, dt, 600):
        level = process_noise.adapt(level, jnp.asarray(e, jnp.float32), jnp.float32(dt), NOISE)
        seen.append(np.asarray(level))
    expected = np.maximum((CAUTION * np.asarray(std)) ** 2, FLOOR**2)
    np.testing.assert_allclose(np.mean(seen[100:], axis=0), expected, rtol=0.25)


@given(
    st.lists(st.floats(-10.0, 10.0, width=32), min_size=6, max_size=6),
    st.floats(0.001, 10.0),
    st.floats(FLOOR**2, 1.0),
)
def test_the_level_stays_in_its_range(e: list[float], dt: float, before: float) -> None:
    """No innovation, however large or small, leads out of it, nor past what that innovation speaks for."""
    start = jnp.full(2, before)
    level = np.asarray(process_noise.adapt(start, jnp.asarray(e), jnp.float32(dt), NOISE))
    assert (level >= FLOOR**2 - 1e-6).all()
    assert (level <= 1.0).all()
    calm = np.asarray(process_noise.adapt(start, jnp.zeros(6), jnp.float32(dt), NOISE))
    assert (level >= calm - 1e-6).all()
    np.testing.assert_allclose(calm, np.maximum(before * np.exp(-dt / TIME), FLOOR**2), rtol=1e-4)


def test_at_a_level_the_variances_are_scaled_by_it() -> None:
    scaled = process_noise.scaled(NOISE, jnp.asarray([0.25, 0.09]))
    for variance, configured in zip(scaled.variances(0.1), NOISE.variances(0.1), strict=True):
        np.testing.assert_allclose(variance / configured, np.repeat([0.25, 0.09], 3), rtol=1e-5)
    np.testing.assert_array_equal(process_noise.full(), [1.0, 1.0])
