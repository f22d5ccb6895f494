"""The query of a cost-to-go: between poses, beside those in collision, beyond the grid, the same in JAX and NumPy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.mpc_worlds import linear_cost
from vssm_gym.planning.value_iteration.cost_to_go import CostToGo

NEVER = linear_cost().never
at_in_jax = jax.jit(CostToGo.at)
slope_in_jax = jax.jit(jax.grad(CostToGo.at, argnums=1))


@given(st.floats(0.0, 5.0), st.floats(0.0, 4.0), st.floats(-20.0, 20.0))
def test_query_is_trilinear_and_periodic(x, y, heading):
    cost = linear_cost()
    planar = np.array([1.0 + 0.5 * x, -1.0 + 0.5 * y, heading])
    k = (heading * 8 / (2.0 * np.pi)) % 8.0
    expected = x + 2.0 * y + 3.0 * abs(k - 4.0)
    inside = cost._corners(planar)[1]
    if inside:  # float32 may put the very border outside
        assert cost.at(planar) == pytest.approx(expected, abs=2e-4)
        assert at_in_jax(cost, planar) == pytest.approx(expected, abs=2e-4)
    assert cost.at(planar).dtype == np.float32


def test_query_leaves_out_poses_in_collision():
    """Next to a pose in collision the value is that of the others; among such poses only there is none."""
    cost = linear_cost()
    pinned = eqx.tree_at(lambda c: c.values, cost, cost.values.at[3:, :, :].set(NEVER))
    planar = np.array([1.0 + 0.5 * 2.75, -1.0 + 0.5 * 1.0, np.pi])  # a quarter of it still open
    assert pinned.at(planar) == pytest.approx(2.0 + 2.0)
    assert pinned.reachable(planar)
    planar[0] += 0.5
    assert pinned.at(planar) == np.float32(NEVER)
    assert not pinned.reachable(planar)
    slope = slope_in_jax(pinned, planar)
    assert np.isfinite(slope).all()


def test_query_beyond_the_grid_and_gradient():
    cost = linear_cost()
    outside = np.array([[0.9, 0.0, 0.0], [4.0, 0.0, 0.0], [2.0, -1.1, 0.0], [2.0, 1.1, 0.0]])
    assert np.all(cost.at(outside) == np.float32(NEVER))
    assert not np.asarray(cost.reachable(outside)).any()
    assert np.all(jax.jit(CostToGo.reachable)(cost, outside) == cost.reachable(outside))
    slope = slope_in_jax(cost, jnp.array([2.1, 0.3, 1.0]))
    assert np.allclose(slope, [2.0, 4.0, -3.0 * 8 / (2.0 * np.pi)], rtol=1e-4)


def test_poses_of_float32_have_the_value_of_jax_to_the_last_bit():
    """Beside poses in collision and beyond the grid, too; poses of float64 have weights of float64."""
    rng = np.random.default_rng(0)
    cost = linear_cost()
    blocked = rng.random(cost.values.shape) < 0.3
    values = np.where(blocked, cost.never, cost.values + rng.random(blocked.shape)).astype(np.float32)
    cost = eqx.tree_at(lambda c: c.values, cost, jnp.asarray(values))
    poses = rng.uniform([0.9, -1.1, -20.0], [3.6, 1.1, 20.0], (3000, 3))
    single = poses.astype(np.float32)
    expected = np.asarray(cost.at(jnp.asarray(single)))
    np.testing.assert_array_equal(cost.at(single), expected)
    np.testing.assert_array_equal([cost.at(pose) for pose in single[:100]], expected[:100])
    assert (cost.at(poses) != expected).any()
