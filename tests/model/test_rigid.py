"""Test the rigid body: laws of motion, Jacobians against finite differences in float64, beliefs against Monte Carlo."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.inference.linear_gaussian import Gaussian, LinearGaussian, joint, split
from vssm_gym.model.transition import RIGID, Rigid, RigidNoise, RigidState, rigid, rigid_belief

DT = 0.1
SAMPLES = 100_000
ROTATION = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
ORDERS = pytest.mark.parametrize("velocity_first", [True, False])

triples = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
sixes = st.tuples(*[st.floats(-2, 2)] * 6).map(np.array)


def pose(t: np.ndarray, R: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def moving(velocity: np.ndarray) -> RigidState:
    return RigidState(jnp.asarray(pose(np.array([1.0, -2.0, 0.5]), ROTATION)), jnp.asarray(velocity))


def correlated(rng: np.random.Generator, n: int, scale: float) -> np.ndarray:
    root = rng.normal(size=(n, n)) * scale / np.sqrt(n)
    return root @ root.T + (0.3 * scale) ** 2 * np.eye(n)


# --- the motion


@given(triples, sixes, sixes, st.booleans())
def test_a_step_is_one_of_eulers_method(
    t: np.ndarray, velocity: np.ndarray, control: np.ndarray, velocity_first: bool
) -> None:
    """A step equals the law of motion in NumPy, with the rotation by a matrix exponential."""
    after = velocity + control * DT
    used = after if velocity_first else velocity
    wx, wy, wz = used[3:] * DT
    R = expm(np.array([[0, -wz, wy], [wz, 0, -wx], [-wy, wx, 0]])) @ ROTATION
    state = RigidState(jnp.asarray(pose(t, ROTATION), jnp.float32), jnp.asarray(velocity, jnp.float32))
    moved = Rigid(velocity_first=velocity_first).mean(state, jnp.asarray(control, jnp.float32), DT)
    np.testing.assert_allclose(np.asarray(moved.velocity), after, atol=1e-5)
    np.testing.assert_allclose(np.asarray(moved.T_world_body), pose(t + used[:3] * DT, R), atol=1e-5)


def test_steps_of_constant_velocity_compose() -> None:
    """Two steps of constant velocity are one of twice the length, however the steps are taken."""
    state, rest = moving(np.array([0.3, -0.2, 0.1, 0.7, 0.5, -0.9])), jnp.zeros(6)
    twice = Rigid().mean(Rigid(velocity_first=False).mean(state, rest, DT), rest, DT)
    once = Rigid().mean(state, rest, 2 * DT)
    np.testing.assert_allclose(np.asarray(twice.T_world_body), np.asarray(once.T_world_body), atol=1e-6)


def test_a_thrown_body_follows_its_parabola() -> None:
    """It falls ``g h^2 n (n + 1) / 2`` with velocity first and ``g h^2 n (n - 1) / 2`` with pose first."""
    n, control = 20, jnp.array([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])
    for velocity_first, sum_of_steps in ((True, n * (n + 1) / 2), (False, n * (n - 1) / 2)):
        state = RigidState(jnp.eye(4), jnp.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        for _ in range(n):
            state = Rigid(velocity_first=velocity_first).mean(state, control, DT)
        expected = [n * DT, 0.0, -9.81 * DT**2 * sum_of_steps]
        np.testing.assert_allclose(np.asarray(state.T_world_body[:3, 3]), expected, rtol=1e-5, atol=1e-6)


def test_rotations_stay_rotations_over_ten_thousand_steps() -> None:
    def step(state, _):
        return Rigid().mean(state, jnp.zeros(6), DT), None

    state, _ = jax.lax.scan(step, moving(np.array([0.0, 0.0, 0.0, 0.9, -0.4, 0.3], np.float32)), length=10_000)
    R = np.asarray(state.T_world_body, float)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-5)


def test_steps_take_batches() -> None:
    rng = np.random.default_rng(0)
    T = np.asarray(se3_exp(jnp.asarray(rng.normal(size=(4, 5, 6)), jnp.float32)))
    velocity, control = (jnp.asarray(rng.normal(size=(4, 5, 6)), jnp.float32) for _ in range(2))
    batch = Rigid().mean(RigidState(jnp.asarray(T), velocity), control, DT)
    one = Rigid().mean(RigidState(jnp.asarray(T[2, 3]), velocity[2, 3]), control[2, 3], DT)
    np.testing.assert_allclose(np.asarray(batch.T_world_body[2, 3]), np.asarray(one.T_world_body), atol=1e-6)
    np.testing.assert_allclose(np.asarray(batch.velocity[2, 3]), np.asarray(one.velocity), atol=1e-6)


@given(sixes, st.integers(0, 2**32 - 1))
def test_errors_undo_perturbations(velocity: np.ndarray, seed: int) -> None:
    xi = np.random.default_rng(seed).normal(scale=0.5, size=12)
    state = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), moving(velocity))
    again = RIGID.error(state, RIGID.perturb(state, jnp.asarray(xi, jnp.float32)))
    np.testing.assert_allclose(np.asarray(again), xi, atol=1e-5)


# --- its linearisation, in float64


@pytest.mark.parametrize("phi", [[0.0, 0.0, 0.0], [1e-5, 0.0, 2e-5], [0.3, -0.2, 0.1], [1.5, -2.0, 0.9]])
def test_right_jacobian_is_the_finite_difference(phi: list[float]) -> None:
    with jax.enable_x64(True):
        actual = np.asarray(rigid.right_jacobian(jnp.asarray(phi, jnp.float64)))
    base, h = Rotation.from_rotvec(phi), 1e-6
    for column, d in enumerate(np.eye(3) * h):
        up = (base.inv() * Rotation.from_rotvec(np.array(phi) + d)).as_rotvec()
        down = (base.inv() * Rotation.from_rotvec(np.array(phi) - d)).as_rotvec()
        np.testing.assert_allclose(actual[:, column], (up - down) / (2 * h), atol=1e-8)


@ORDERS
@pytest.mark.parametrize("speed", [0.0, 0.5, 6.0])
def test_prediction_is_linearised_as_autodiff_does(velocity_first: bool, speed: float) -> None:
    """``F P F^T + G Q G^T`` with F and G by forward differentiation of the perturbed step; float64."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(4)
        state = moving(rng.normal(size=6) * speed)
        control, P = jnp.asarray(rng.normal(size=6)), jnp.asarray(correlated(rng, 12, 0.1))
        noise = RigidNoise(0.04, 0.03, 0.02, 0.01)
        body = Rigid(noise, velocity_first)
        mean = body.mean(state, control, DT)

        def step(xi, e_velocity, e_pose):
            start = RIGID.perturb(state, xi)
            new = start.velocity + control * DT + e_velocity
            T = rigid.move(start.T_world_body, new if velocity_first else start.velocity, DT) @ se3_exp(e_pose)
            return RIGID.error(mean, RigidState(T, new))

        at = jnp.zeros(12), jnp.zeros(6), jnp.zeros(6)
        F, G_velocity, G_pose = jax.jacfwd(step, argnums=(0, 1, 2))(*at)
        pose_variance, velocity_variance = noise.variances(DT)
        expected = F @ P @ F.T + G_velocity * velocity_variance @ G_velocity.T + G_pose * pose_variance @ G_pose.T
        predicted = body.predict(rigid_belief(state, P), control, DT)
        np.testing.assert_allclose(np.asarray(predicted.covariance), np.asarray(expected), rtol=1e-9, atol=1e-12)


@ORDERS
def test_prediction_agrees_with_monte_carlo(velocity_first: bool) -> None:
    """The prediction agrees with 1e5 bodies drawn from belief and noise and moved without linearisation."""
    rng = np.random.default_rng(5)
    control = np.array([0.5, 1.0, -0.3, 2.0, 0.0, -1.0])
    P = correlated(rng, 12, 0.06)
    noise = RigidNoise()
    with jax.enable_x64(True):
        state = moving(np.array([0.8, -0.5, 0.2, 1.5, -2.0, 1.0]))
        start = rigid_belief(state, jnp.asarray(P))
        predicted = Rigid(noise, velocity_first).predict(start, jnp.asarray(control), DT)
        starts = RIGID.perturb(state, jnp.asarray(rng.multivariate_normal(np.zeros(12), P, SAMPLES)))
        stds = np.sqrt(np.concatenate(noise.variances(DT)))
        e = jnp.asarray(rng.standard_normal((SAMPLES, 12)) * stds)
        velocity = starts.velocity + control * DT + e[:, 6:]
        T = rigid.move(starts.T_world_body, velocity if velocity_first else starts.velocity, DT)
        xi = np.asarray(RIGID.error(predicted.mean, RigidState(T @ se3_exp(e[:, :6]), velocity)))
    covariance = np.asarray(predicted.covariance)
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(xi.mean(axis=0) / scale, 0.0, atol=0.03)
    np.testing.assert_allclose(np.cov(xi.T) / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=0.03)


@ORDERS
def test_float32_prediction_is_the_float64_one(velocity_first: bool) -> None:
    rng = np.random.default_rng(6)
    with jax.enable_x64(True):
        belief = rigid_belief(moving(rng.normal(size=6)), jnp.asarray(correlated(rng, 12, 0.1)))
        control = jnp.asarray(rng.normal(size=6))
        exact = Rigid(velocity_first=velocity_first).predict(belief, control, DT)
    single = jax.tree.map(lambda a: jnp.asarray(np.asarray(a), jnp.float32), (belief, control))
    actual = Rigid(velocity_first=velocity_first).predict(*single, DT)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(exact), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(np.asarray(a), b, atol=2e-6)


def test_variances_grow_with_time() -> None:
    """Ten steps of 0.1 s and one of 1 s leave a body at rest equally uncertain in its velocity."""
    start = rigid_belief(RigidState(jnp.eye(4), jnp.zeros(6)), jnp.zeros((12, 12)))
    many = start
    for _ in range(10):
        many = Rigid().predict(many, jnp.zeros(6), 0.1)
    once = Rigid().predict(start, jnp.zeros(6), 1.0)
    velocities = [np.diag(np.asarray(b.covariance))[6:] for b in (many, once)]
    np.testing.assert_allclose(*velocities, rtol=1e-5)
    np.testing.assert_allclose(velocities[0], 10 * 0.03**2, rtol=1e-5)


# --- PRISM's split


def test_the_split_of_a_prediction_gives_velocity_from_pose() -> None:
    """``q(pose) q(vel | pose)`` is the prediction (PRISM, steps 1 and 4); a pose further ahead means a higher speed."""
    belief = rigid_belief(RigidState(jnp.eye(4), jnp.zeros(6)), jnp.diag(jnp.full(12, 0.1)))
    noise = RigidNoise(0.03, 1e-3, 0.03, 1e-3)
    still = rigid_belief(belief.mean, belief.covariance.at[:6, :6].set(jnp.eye(6) * 1e-6))
    predicted = Rigid(noise).predict(still, jnp.zeros(6), DT)
    p_pose, p_velocity = split(Gaussian(jnp.zeros(12), predicted.covariance), 6)
    whole = joint(p_pose, p_velocity)
    np.testing.assert_allclose(np.asarray(whole.covariance), np.asarray(predicted.covariance), atol=1e-6)
    # Pose noise 1 mm and old pose known to 1 mm: a body found 5 cm ahead moved at almost 0.05 / 0.1 m/s
    ahead = jnp.zeros(6).at[0].set(0.05)
    velocity = p_velocity.given(ahead)
    np.testing.assert_allclose(np.asarray(velocity.mean), np.eye(6)[0] * 0.5, atol=0.01)
    assert float(velocity.covariance[0, 0]) < 0.02**2 < float(predicted.covariance[6, 6])
    posterior = joint(
        Gaussian(ahead, jnp.eye(6) * 1e-8), LinearGaussian(p_velocity.A, p_velocity.a, p_velocity.covariance)
    )
    assert np.linalg.eigvalsh(np.asarray(posterior.covariance, float)).min() > -1e-7
