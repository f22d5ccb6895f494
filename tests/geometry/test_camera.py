"""Test the pinhole camera: projection and its inverse, resizing, field of view; checked by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vssm_gym.geometry.camera import Camera

sizes = st.integers(4, 48)
cameras = st.builds(
    lambda w, h, f, aspect, dx, dy: Camera(w, h, f * w, f * w * aspect, w * dx, h * dy),
    sizes,
    sizes,
    st.floats(0.3, 3.0),
    st.floats(0.8, 1.2),
    st.floats(0.3, 0.7),
    st.floats(0.3, 0.7),
)


@jax.jit
def there_and_back(camera: Camera, depth: jax.Array) -> tuple[jax.Array, jax.Array]:
    return camera.project(camera.backproject(depth))


@given(cameras, st.integers(0, 2**32 - 1))
def test_projection_inverts_backprojection(camera: Camera, seed: int) -> None:
    camera = camera.resized(17, 12)
    depth = np.random.default_rng(seed).uniform(0.1, 8.0, (camera.height, camera.width)).astype(np.float32)
    uv, z = there_and_back(camera, jnp.asarray(depth))
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    np.testing.assert_allclose(np.asarray(uv), np.stack([u, v], axis=-1), atol=1e-4 * camera.width)
    np.testing.assert_allclose(np.asarray(z), depth, rtol=1e-6)


@given(cameras, arrays(np.float64, (9, 3), elements=st.floats(-3.0, 3.0)))
def test_projection_is_the_matrix_K(camera: Camera, p: np.ndarray) -> None:
    p[:, 2] = np.abs(p[:, 2]) + 0.1
    uv, z = camera.project(jnp.asarray(p, jnp.float32))
    homogeneous = p @ camera.K.T
    np.testing.assert_allclose(np.asarray(uv), homogeneous[:, :2] / homogeneous[:, 2:], rtol=1e-4, atol=1e-2)
    np.testing.assert_allclose(np.asarray(z), p[:, 2], rtol=1e-6)


def test_backprojection_by_hand() -> None:
    """f = 100, c = (50, 40): pixel (70, 10) at 2 m is 0.4 m to the right and 0.6 m up."""
    camera = Camera(101, 81, 100.0, 100.0, 50.0, 40.0)
    p_cam = camera.backproject(jnp.full((81, 101), 2.0))
    np.testing.assert_allclose(np.asarray(p_cam[10, 70]), [0.4, -0.6, 2.0], rtol=1e-6)
    np.testing.assert_allclose(np.asarray(camera.rays()[40, 50]), [0.0, 0.0, 1.0])


def test_no_reading_is_the_origin() -> None:
    camera = Camera.from_hfov(6, 4, 1.2)
    np.testing.assert_array_equal(np.asarray(camera.backproject(jnp.zeros((4, 6)))), 0.0)


def test_points_behind_the_camera_land_outside() -> None:
    camera = Camera.from_hfov(6, 4, 1.2)
    uv, z = camera.project(jnp.array([[0.0, 0.0, -1.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]))
    assert bool((uv[:2] < -1000).all())
    np.testing.assert_allclose(np.asarray(uv[2]), [2.5, 1.5])
    np.testing.assert_array_equal(np.asarray(z), [-1.0, 0.0, 1.0])


def test_projection_has_finite_gradients_behind_the_camera() -> None:
    camera = Camera.from_hfov(6, 4, 1.2)
    gradients = jax.jit(jax.jacrev(lambda p: camera.project(p)[0]))
    for p in ([0.1, 0.2, 0.0], [0.1, 0.2, -1.0], [0.1, 0.2, 2.0]):
        gradient = gradients(jnp.array(p))
        assert bool(jnp.isfinite(gradient).all())


@given(cameras, sizes, sizes)
def test_resizing_keeps_the_edges_of_the_view(camera: Camera, width: int, height: int) -> None:
    """The rays through the image's four edges (half a pixel outside the border centres) do not move."""
    small = camera.resized(width, height)
    assert (small.width, small.height) == (width, height)
    for before, after in ((camera, small), (camera, small.resized(camera.width, camera.height))):
        assert (-0.5 - before.cx) / before.fx == pytest.approx((-0.5 - after.cx) / after.fx)
        assert (before.width - 0.5 - before.cx) / before.fx == pytest.approx((after.width - 0.5 - after.cx) / after.fx)
        assert (-0.5 - before.cy) / before.fy == pytest.approx((-0.5 - after.cy) / after.fy)
        assert (before.height - 0.5 - before.cy) / before.fy == pytest.approx(
            (after.height - 0.5 - after.cy) / after.fy
        )


@given(st.floats(0.2, 2.8), sizes, sizes)
def test_field_of_view_is_edge_to_edge(hfov: float, width: int, height: int) -> None:
    camera = Camera.from_hfov(width, height, hfov)
    left, right = (-0.5 - camera.cx) / camera.fx, (width - 0.5 - camera.cx) / camera.fx
    assert np.arctan(right) - np.arctan(left) == pytest.approx(hfov)
    assert camera.fx == camera.fy
    assert camera.cy == pytest.approx(0.5 * (height - 1))


def test_ninety_degrees_by_hand() -> None:
    """160 pixels over 90 degrees: f = 80 pixels."""
    np.testing.assert_allclose(
        Camera.from_hfov(160, 120, np.pi / 2).K, [[80.0, 0.0, 79.5], [0.0, 80.0, 59.5], [0.0, 0.0, 1.0]]
    )


@given(cameras)
def test_matrix_round_trip(camera: Camera) -> None:
    again = Camera.from_matrix(camera.K, camera.width, camera.height)
    assert again == camera
