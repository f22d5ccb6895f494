"""Test the kinematic bicycle: circles, an ODE solver as oracle, beliefs against Monte Carlo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from vssm_gym.model.transition import PLANAR, Bicycle, BicycleNoise, bicycle, planar_belief

L, DT = 0.26, 0.1
SAMPLES = 100_000
CAR = Bicycle(BicycleNoise(), L)
CONTROLS = [(1.0, 0.0), (0.8, 0.4), (-0.5, -0.3), (2.0, 1e-4), (0.0, 0.3)]

controls = st.tuples(st.floats(-3, 3), st.floats(-0.6, 0.6)).map(np.array)
poses = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-3.1, 3.1)).map(np.array)


def f32(a) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


@given(poses, controls)
def test_an_arc_solves_the_differential_equation(pose: np.ndarray, control: np.ndarray) -> None:
    """``x. = v cos, y. = v sin, heading. = v tan(steering) / L``, by an adaptive solver in float64."""

    def rate(_, z):
        return [control[0] * np.cos(z[2]), control[0] * np.sin(z[2]), control[0] * np.tan(control[1]) / L]

    truth = solve_ivp(rate, (0.0, DT), pose, rtol=1e-10, atol=1e-12).y[:, -1]
    moved = np.asarray(CAR.mean(f32(pose), f32(control), DT), float)
    np.testing.assert_allclose(moved[:2], truth[:2], atol=2e-6)
    assert abs(np.exp(1j * moved[2]) - np.exp(1j * truth[2])) < 2e-6


def test_a_full_circle_closes() -> None:
    """Constant steering for the time of one turn, 2 pi L / (v tan(steering)), however it is cut into steps."""
    control = np.array([1.0, 0.35])
    dt = 2 * np.pi * L / np.tan(0.35) / 40
    pose = f32([1.0, 2.0, 0.3])
    for _ in range(40):
        pose = CAR.mean(pose, f32(control), dt)
    np.testing.assert_allclose(np.asarray(pose), [1.0, 2.0, 0.3], atol=1e-5)


@given(poses, controls)
def test_driving_back_undoes_driving(pose: np.ndarray, control: np.ndarray) -> None:
    there = CAR.mean(f32(pose), f32(control), DT)
    back = np.asarray(CAR.mean(there, f32(control * [-1, 1]), DT), float)
    np.testing.assert_allclose(back[:2], pose[:2], atol=2e-6)
    assert abs(np.exp(1j * back[2]) - np.exp(1j * pose[2])) < 2e-6


@pytest.mark.parametrize("turn", [0.0, 0.0999, 0.1001, -0.1, 0.2001, 0.8])
def test_the_arc_is_smooth_where_its_series_ends(turn: float) -> None:
    """Value and derivative in float32 against finite differences in float64, on both sides of the seam."""
    steering = np.arctan(turn * L)
    jacobian = np.asarray(jax.jacfwd(bicycle.arc)(f32([1.0, steering]), 1.0, L), float)

    def exact(c):
        s, a = c[0], c[0] * np.tan(c[1]) / L
        return np.array([s * np.sinc(a / np.pi), s * a / 2 * np.sinc(a / 2 / np.pi) ** 2, a])

    h, at = 1e-6, np.array([1.0, steering])
    for column, d in enumerate(np.eye(2) * h):
        expected = (exact(at + d) - exact(at - d)) / (2 * h)
        np.testing.assert_allclose(jacobian[:, column], expected, atol=2e-5)


@pytest.mark.parametrize("control", CONTROLS)
def test_prediction_agrees_with_samples(control: tuple[float, float]) -> None:
    """The linearised prediction agrees with 1e5 cars drawn from the belief and driven."""
    rng = np.random.default_rng(1)
    root = np.array([[0.03, 0.0, 0.0], [0.01, 0.02, 0.0], [-0.01, 0.015, 0.04]])
    mean = f32([0.4, -0.7, 3.0])
    starts = PLANAR.perturb(mean, f32(rng.standard_normal((SAMPLES, 3)) @ root.T))
    moved = CAR.sample(jax.random.key(0), starts, jnp.broadcast_to(f32(control), (SAMPLES, 2)), DT)
    predicted = CAR.predict(planar_belief(mean, f32(root @ root.T)), f32(control), DT)
    xi = np.asarray(PLANAR.error(predicted.mean, moved), float)
    covariance = np.asarray(predicted.covariance, float)
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(xi.mean(axis=0) / scale, 0.0, atol=0.03)
    np.testing.assert_allclose(np.cov(xi.T) / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.03)


@pytest.mark.parametrize("control", [(1.5, 0.5), (-2.0, 0.3)])
def test_prediction_is_linearised_as_autodiff_does(control: tuple[float, float]) -> None:
    """Steps of half a radian and more with steering noise alone test the frame of the noise's columns."""
    start, u, dt = f32([0.4, -0.7, 3.0]), f32(control), 0.4
    noise = BicycleNoise(0.1, 0.1, 0.0, 0.0, 0.0)
    car = Bicycle(noise, L)
    P = f32(np.diag([0.03, 0.02, 0.04]) ** 2)
    mean = car.mean(start, u, dt)
    moved = lambda xi, e: PLANAR.error(mean, car.mean(PLANAR.perturb(start, xi), u + e, dt))
    F, G = (np.asarray(J, float) for J in jax.jacfwd(moved, argnums=(0, 1))(jnp.zeros(3), jnp.zeros(2)))
    G = G * np.asarray(noise.control_stds(u, dt), float)
    predicted = car.predict(planar_belief(start, P), u, dt)
    expected = F @ np.asarray(P, float) @ F.T + G @ G.T
    np.testing.assert_allclose(np.asarray(predicted.covariance, float), expected, atol=2e-3 * np.abs(expected).max())


def test_variances_do_not_depend_on_the_division_of_time() -> None:
    """On a straight line the variances after one step of 0.4 s equal those after four of 0.1 s."""
    start = planar_belief(jnp.zeros(3), jnp.zeros((3, 3)))
    control = f32([1.0, 0.0])
    once, many = CAR.predict(start, control, 0.4), start
    for _ in range(4):
        many = CAR.predict(many, control, 0.1)
    for i in (0, 2):
        np.testing.assert_allclose(float(once.covariance[i, i]), float(many.covariance[i, i]), rtol=1e-4)


def test_a_standing_car_only_slips() -> None:
    start = planar_belief(f32([1.0, 2.0, 0.5]), jnp.zeros((3, 3)))
    after = CAR.predict(start, f32([0.0, 0.4]), DT)
    np.testing.assert_allclose(np.asarray(after.mean), [1.0, 2.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(np.asarray(after.covariance), np.eye(3) * 0.002**2, rtol=1e-5, atol=1e-12)
