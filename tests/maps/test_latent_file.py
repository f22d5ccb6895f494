"""Test that a latent grid is read as it was written, and that damaged files are refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.errors import InputError
from vssm_gym.inference.latent.chart_update import add
from vssm_gym.maps.latent_file import load_latent_grid, save_latent_grid
from vssm_gym.maps.latent_grid import ChartDecoder, LatentGrid

BEARINGS = 12


@pytest.fixture(scope="module")
def grid():
    """Return a grid with readings in some of its cells."""
    rng = np.random.default_rng(0)
    decoder = ChartDecoder(jnp.float32(0.4), jnp.asarray(rng.normal(size=(5, BEARINGS)), jnp.float32))
    m = LatentGrid.prior(np.array([-1.0, 2.0]), np.array([0.0, 2.6]), 0.2, decoder)
    for k in range(4):
        y, weight = (jnp.asarray(rng.uniform(0.2, 2.0, (4, BEARINGS)), jnp.float32) for _ in range(2))
        i, j = jnp.array([0, 1, 0, 1]) + k % 3, jnp.array([0, 0, 1, 1]) + k % 2
        m = add(m, i, j, y, weight)
    return m


def test_charts_follow_from_the_natural_parameters(grid):
    """Writing reading by reading leaves the posterior of the sums."""
    again = LatentGrid.of(grid.weight, grid.moment, grid.origin, grid.cell_size, grid.decoder)
    np.testing.assert_allclose(again.chart, grid.chart, atol=2e-4)
    np.testing.assert_allclose(again.spread, grid.spread, atol=2e-4)


def test_a_file_is_read_as_it_was_written(grid, tmp_path):
    save_latent_grid(tmp_path / "charts.npz", grid)
    found = load_latent_grid(tmp_path / "charts.npz")
    for name in ("weight", "moment", "origin", "cell_size"):
        np.testing.assert_array_equal(getattr(found, name), getattr(grid, name))
    np.testing.assert_array_equal(found.decoder.basis, grid.decoder.basis)
    np.testing.assert_allclose(found.chart, grid.chart, atol=2e-4)
    drawn = found.draw(jax.random.key(0))
    assert np.isfinite(np.asarray(drawn.chart)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weight": np.full((3, 4, BEARINGS), -1.0, np.float32)}, "weight"),
        ({"moment": np.zeros((3, 4, 5), np.float32)}, "weight"),
        ({"cell_size": np.float32(0.0)}, "cell_size"),
        ({"origin": np.zeros(3, np.float32)}, "cell_size"),
        ({"decoder_basis": np.zeros((5, 7), np.float32)}, "decoder_basis"),
        ({"decoder_mean": np.float32(np.nan)}, "decoder_mean: expected finite"),
    ],
)
def test_what_is_no_grid_is_refused(grid, tmp_path, change, message):
    save_latent_grid(tmp_path / "charts.npz", grid)
    arrays = dict(np.load(tmp_path / "charts.npz")) | change
    np.savez(tmp_path / "charts.npz", **arrays)
    with pytest.raises(InputError, match=message):
        load_latent_grid(tmp_path / "charts.npz")
