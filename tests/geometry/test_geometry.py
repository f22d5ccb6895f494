"""Test rigid motions: the group's laws, the exponential and its inverse, planar poses; NumPy and JAX alike."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from vssm_gym.geometry.transforms import (
    R_BODY_CAM,
    inverse,
    matrix_to_planar,
    planar_to_matrix,
    se3_adjoint,
    se3_exp,
    se3_log,
    transform,
    wrap_angle,
)

metres = st.floats(-20.0, 20.0)
angles = st.floats(-50.0, 50.0)
points = arrays(np.float64, (7, 3), elements=metres)


@st.composite
def motions(draw) -> np.ndarray:
    """Return 4x4 rigid matrices, float64."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(draw(arrays(np.float64, 3, elements=st.floats(-4.0, 4.0)))).as_matrix()
    T[:3, 3] = draw(arrays(np.float64, 3, elements=metres))
    return T


# Rotations short of pi, where the logarithm is unique
tangents = st.builds(
    lambda t, axis, angle: np.concatenate([t, angle * axis / max(np.linalg.norm(axis), 1e-9)]),
    arrays(np.float64, 3, elements=st.floats(-5.0, 5.0)),
    arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)),
    st.one_of(st.floats(0.0, 3.1), st.sampled_from([0.0, 1e-12, 1e-7, 1e-4, 1e-3, 3e-3, 0.1, 0.3, 0.32])),
)
planars = st.tuples(metres, metres, st.floats(-3.1415, 3.1415)).map(np.array)


@given(motions(), motions(), motions(), points)
def test_group_axioms(A: np.ndarray, B: np.ndarray, C: np.ndarray, p: np.ndarray) -> None:
    """Closure, associativity of the action, identity, inverse."""
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-9)
    np.testing.assert_allclose(transform(A @ B, p), transform(A, transform(B, p)), atol=1e-9)
    np.testing.assert_array_equal(transform(np.eye(4), p), p)
    np.testing.assert_allclose(inverse(A) @ A, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(A @ inverse(A), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(inverse(A @ B), inverse(B) @ inverse(A), atol=1e-10)
    np.testing.assert_allclose(inverse(inverse(A)), A, atol=1e-12)


@given(motions(), points)
def test_motions_keep_distances(T: np.ndarray, p: np.ndarray) -> None:
    moved = transform(T, p)
    np.testing.assert_allclose(
        np.linalg.norm(moved - moved[:1], axis=-1), np.linalg.norm(p - p[:1], axis=-1), atol=1e-9
    )


@given(motions(), points)
def test_numpy_and_jax_agree(T: np.ndarray, p: np.ndarray) -> None:
    """The same numbers in float64 and float32, each in the namespace and precision of its argument."""
    T32, p32 = jnp.asarray(T, jnp.float32), jnp.asarray(p, jnp.float32)
    for result, single in ((transform(T, p), transform(T32, p32)), (inverse(T), inverse(T32))):
        assert isinstance(result, np.ndarray)
        assert result.dtype == np.float64
        assert isinstance(single, jax.Array)
        assert single.dtype == jnp.float32
        np.testing.assert_allclose(result, np.asarray(single), atol=2e-4)


def test_batches_broadcast() -> None:
    T = np.stack([planar_to_matrix(np.array([i, 2.0, 0.3 * i])) for i in range(5)])
    p = np.arange(15.0).reshape(5, 3)
    np.testing.assert_allclose(transform(T, p), [transform(a, b) for a, b in zip(T, p, strict=True)])
    np.testing.assert_allclose(inverse(T), [inverse(a) for a in T], atol=1e-15)
    np.testing.assert_allclose(matrix_to_planar(T), [matrix_to_planar(a) for a in T])


@given(tangents)
def test_exponential_is_the_matrix_exponential(delta: np.ndarray) -> None:
    """se(3) elements have a zero in the corner: ``exp [[w^, v], [0, 0]]`` by SciPy, float64."""
    v, (a, b, c) = delta[:3], delta[3:]
    generator = np.zeros((4, 4))
    generator[:3, :3] = [[0, -c, b], [c, 0, -a], [-b, a, 0]]
    generator[:3, 3] = v
    np.testing.assert_allclose(np.asarray(se3_exp(jnp.asarray(delta, jnp.float32))), expm(generator), atol=2e-5)


@given(tangents)
def test_logarithm_inverts_the_exponential(delta: np.ndarray) -> None:
    """To the precision of either float."""
    single = np.asarray(se3_log(se3_exp(jnp.asarray(delta, jnp.float32))))
    np.testing.assert_allclose(single, delta, atol=2e-4)
    with jax.enable_x64(True):
        back = np.asarray(se3_log(se3_exp(jnp.asarray(delta))))
    np.testing.assert_allclose(back, delta, atol=1e-6)


@given(motions(), tangents)
def test_adjoint_carries_tangents_between_frames(T: np.ndarray, delta: np.ndarray) -> None:
    """``T exp(delta) T^-1 = exp(Ad_T delta)``."""
    with jax.enable_x64(True):
        T_a_b, d = jnp.asarray(T), jnp.asarray(delta)
        left, right = T_a_b @ se3_exp(d) @ inverse(T_a_b), se3_exp(se3_adjoint(T_a_b) @ d)
    np.testing.assert_allclose(np.asarray(left), np.asarray(right), atol=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.3, 0.33, 2.0])
def test_exponential_differentiates_alike_both_ways(angle: float) -> None:
    """Forward = reverse = finite difference, at zero rotation and on both sides of the series too."""
    delta = jnp.array([0.3, -0.2, 0.5, *(angle * np.array([0.8, 0.0, 0.6]))])
    forward, reverse = jacobians(delta)
    assert bool(jnp.isfinite(forward).all())
    np.testing.assert_allclose(np.asarray(forward), np.asarray(reverse), atol=1e-6)
    with jax.enable_x64(True):
        d, h = np.asarray(delta, float), 1e-6
        steps = jnp.asarray(np.concatenate([d + h * np.eye(6), d - h * np.eye(6)]))
        high, low = np.split(np.asarray(se3_exp(steps)), 2)
    np.testing.assert_allclose(np.asarray(forward), np.moveaxis((high - low) / (2 * h), 0, -1), atol=1e-5)


jacobians = jax.jit(lambda delta: (jax.jacfwd(se3_exp)(delta), jax.jacrev(se3_exp)(delta)))


@given(planars, points)
def test_planar_round_trip(planar: np.ndarray, p: np.ndarray) -> None:
    T = planar_to_matrix(planar)
    np.testing.assert_allclose(matrix_to_planar(T), planar, atol=1e-12)
    np.testing.assert_allclose(transform(T, p)[:, 2], p[:, 2])  # motions of the floor keep heights
    np.testing.assert_allclose(np.linalg.det(T), 1.0)
    single = matrix_to_planar(planar_to_matrix(jnp.asarray(planar, jnp.float32)))
    np.testing.assert_allclose(np.asarray(single), planar, atol=1e-5)


def test_planar_poses_by_hand() -> None:
    """At (1, 2), turned a quarter to the left: a point 3 m ahead lies at (1, 5)."""
    T_world_body = planar_to_matrix(np.array([1.0, 2.0, np.pi / 2]))
    np.testing.assert_allclose(transform(T_world_body, np.array([3.0, 0.0, 0.5])), [1.0, 5.0, 0.5], atol=1e-12)


def test_the_camera_faces_ahead() -> None:
    """Camera z is body x, camera x (image right) is body -y, camera y (image down) is body -z."""
    R = np.array(R_BODY_CAM)
    np.testing.assert_array_equal(R @ [0, 0, 1], [1, 0, 0])
    np.testing.assert_array_equal(R @ [1, 0, 0], [0, -1, 0])
    np.testing.assert_array_equal(R @ [0, 1, 0], [0, 0, -1])
    assert np.linalg.det(R) == 1.0


@given(angles, st.integers(-5, 5))
def test_wrapped_angles(angle: float, turns: int) -> None:
    wrapped = wrap_angle(np.array(angle))
    assert -np.pi <= wrapped <= np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)
    again = wrap_angle(np.array(angle + 2 * np.pi * turns))
    assert abs(np.exp(1j * again) - np.exp(1j * wrapped)) < 1e-9
    assert float(wrap_angle(jnp.float32(angle))) == pytest.approx(float(wrap_angle(np.float32(angle))), abs=1e-5)


def test_wrapped_angles_by_hand() -> None:
    np.testing.assert_allclose(
        wrap_angle(np.array([0.0, np.pi, -np.pi, 3.0, -4.0, 7.0])),
        [0.0, -np.pi, -np.pi, 3.0, 2 * np.pi - 4.0, 7.0 - 2 * np.pi],
    )
