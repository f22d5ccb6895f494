"""Test the adaptive process noise: the noise scale that a hand with known acceleration gets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.inference.tracking import process_noise
from vssm_gym.inference.tracking.process_noise import ProcessNoiseConfig
from vssm_gym.model.transition import PLANAR, RIGID, Rigid, RigidNoise

NOISE = RigidNoise(0.15, 0.01, 0.3, 0.01)
CONFIG = ProcessNoiseConfig()


@jax.jit
def step(level, moved, predicted, posterior, dt):
    """Adapt to an innovation, normalised by the noise of a step of a body at rest."""
    rest = RIGID.resting(jnp.eye(4))
    noise = Rigid(NOISE).noise_covariance(rest, jnp.zeros(6), dt)[:6, :6]
    return process_noise.adapt(level, moved, predicted, posterior, dt, noise, RIGID, CONFIG)


def adapt(level, moved, dt: float, left: float = 0.0) -> jnp.ndarray:
    """Adapt to an image that leaves the share ``left`` of the prediction's uncertainty."""
    P = jnp.diag(jnp.asarray([2e-4] * 3 + [5e-4] * 3))
    return step(level, jnp.asarray(moved, jnp.float32), P, left * P, jnp.float32(dt))


def innovations(rng: np.random.Generator, std: tuple[float, float], dt: float, n: int) -> np.ndarray:
    """Draw innovations of a hand whose noise is ``std`` of the configured one."""
    pose, velocity = (np.asarray(v, float) for v in NOISE.variances(dt))
    return rng.standard_normal((n, 6)) * np.sqrt(pose + velocity * dt**2) * np.repeat(std, 3)


@pytest.mark.parametrize("dt", [1 / 30, 0.1, 0.5])
@pytest.mark.parametrize("std", [(0.05, 0.3), (0.3, 0.5), (0.4, 0.02)])
def test_the_scale_is_the_hands_own_times_a_margin(std: tuple[float, float], dt: float) -> None:
    """Its mean over a long time is ``(c s)^2``, or the floor, for translation and rotation separately."""
    level, seen = process_noise.full(), []
    for e in innovations(np.random.default_rng(0), std, dt, 600):
        level = adapt(level, e, dt)
        seen.append(np.asarray(level))
    expected = np.maximum((CONFIG.caution * np.asarray(std)) ** 2, CONFIG.floor**2)
    np.testing.assert_allclose(np.mean(seen[100:], axis=0), expected, rtol=0.25)


@given(
    st.lists(st.floats(-10.0, 10.0, width=32), min_size=6, max_size=6),
    st.floats(0.001, 10.0),
    st.floats(CONFIG.floor**2, 1.0),
)
def test_the_scale_stays_in_its_range(e: list[float], dt: float, before: float) -> None:
    """No innovation, however large or small, moves it out of the range or beyond the scale of that innovation."""
    start = jnp.full(2, before)
    level = np.asarray(adapt(start, e, dt))
    assert (level >= CONFIG.floor**2 - 1e-6).all()
    assert (level <= 1.0).all()
    calm = np.asarray(adapt(start, np.zeros(6), dt))
    assert (level >= calm - 1e-6).all()
    np.testing.assert_allclose(
        calm, np.maximum(before * np.exp(-dt / CONFIG.time_constant), CONFIG.floor**2), rtol=1e-4
    )


def test_the_variances_are_multiplied_by_the_scale() -> None:
    """Translation and linear velocity by one factor, rotation and angular velocity by the other, in every block."""
    factors = np.asarray(process_noise.scale(RIGID, jnp.asarray([0.25, 0.09])))
    np.testing.assert_allclose(factors, np.tile(np.repeat([0.5, 0.3], 3), 2), rtol=1e-6)
    np.testing.assert_allclose(process_noise.scale(PLANAR, jnp.asarray([0.25, 0.09])), [0.5, 0.5, 0.3], rtol=1e-6)
    state = RIGID.perturb(RIGID.resting(jnp.eye(4)), jnp.arange(12) * 0.05)
    known, linear, angular = Rigid(NOISE), 0.5, 0.3
    scaled = Rigid(
        RigidNoise(*(s * f for s, f in zip((0.15, 0.01, 0.3, 0.01), (linear, linear, angular, angular), strict=True)))
    )
    whole = np.asarray(known.noise_covariance(state, jnp.zeros(6), 0.1))
    expected = np.asarray(scaled.noise_covariance(state, jnp.zeros(6), 0.1))
    np.testing.assert_allclose(factors[:, None] * whole * factors, expected, rtol=1e-4, atol=1e-9)
    np.testing.assert_array_equal(process_noise.full(), [1.0, 1.0])


def test_an_image_without_information_changes_nothing() -> None:
    """In front of a blank wall the pose is the prior's, which is no evidence of a steady hand."""
    level = jnp.asarray([0.3, 0.7])
    np.testing.assert_allclose(adapt(level, np.zeros(6), 0.1, left=1.0), level, rtol=1e-5)
    half = np.asarray(adapt(level, np.zeros(6), 0.1, left=0.5))
    assert (half < np.asarray(level)).all() and (half > np.asarray(adapt(level, np.zeros(6), 0.1))).all()


@pytest.mark.parametrize("blind", [[], [0], [0, 1]], ids=["sees", "one axis blind", "two axes blind"])
def test_the_scale_depends_on_observed_directions_only(blind: list[int]) -> None:
    """Run a Kalman filter of position and velocity per axis in float64, its process noise adapted in the loop.

    The hand has the configured noise. An axis that the image does not see must not lower the scale: the variances
    that the filter claims of the blind axes, whose errors grow, stay about right (NEES over dimension near 1).
    """
    rng, dt = np.random.default_rng(0), 0.1
    pose, velocity = (np.asarray(v, float)[:3] for v in NOISE.variances(jnp.float32(dt)))
    noise_std = np.full(3, 0.002)
    noise_std[blind] = 1e3
    nees = []
    for _ in range(40):
        truth, mean = np.zeros((3, 2)), np.zeros((3, 2))
        P = np.tile(np.diag([1e-6, 0.01]), (3, 1, 1))
        level = process_noise.full()
        F = np.array([[1.0, dt], [0.0, 1.0]])
        for _ in range(30):
            truth[:, 1] += rng.standard_normal(3) * np.sqrt(velocity)
            truth[:, 0] += dt * truth[:, 1] + rng.standard_normal(3) * np.sqrt(pose)
            s2 = float(level[0])
            G = np.array([dt, 1.0])
            Q = s2 * (velocity[:, None, None] * np.outer(G, G) + pose[:, None, None] * np.diag([1.0, 0.0]))
            mean, P = mean @ F.T, F @ P @ F.T + Q
            K = P[:, :, 0] / (P[:, 0, 0] + noise_std**2)[:, None]
            innovation = truth[:, 0] + rng.standard_normal(3) * noise_std - mean[:, 0]
            before = np.diag(P[:, 0, 0])
            mean = mean + K * innovation[:, None]
            P = P - K[:, :, None] * P[:, None, 0, :]
            six = np.eye(6) * 1e-4
            was, now = six.copy(), 0.5 * six
            was[:3, :3], now[:3, :3] = before, np.diag(P[:, 0, 0])
            moved = np.concatenate([K[:, 0] * innovation, np.zeros(3)])
            args = (jnp.asarray(a, jnp.float32) for a in (moved, was, now))
            level = step(level, *args, jnp.float32(dt))
        error = truth[:, 0] - mean[:, 0]
        nees.append(error**2 / P[:, 0, 0])
    off = np.mean(nees, axis=0)
    assert (off < 2.0).all() and (off > 0.3).all(), off
    assert float(level[0]) > 0.5
