"""Test ``q(z) q(M)``: samples, densities and entropies agree; files are read back; damage is one error."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jaxtyping import Array, Float, PRNGKeyArray
from scipy.stats import norm

from tests.helpers.damage import damaged_bytes, damaged_json
from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import se3_exp
from vssm_gym.maps import map_file
from vssm_gym.maps.block_table import BlockTable
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_STD, VoxelMap
from vssm_gym.model.map_samples import deform
from vssm_gym.model.posterior import Posterior, map_entropy
from vssm_gym.model.transition import PLANAR, Belief, GaussianBelief, RigidState, planar_belief, rigid_belief
from vssm_gym.model.transition.with_rest import RestState, WithRest

CELL = 0.1  # m
PRECISION = 4.0  # observations of an observed cell


def f32(a: Any) -> jax.Array:
    return jnp.asarray(a, jnp.float32)


def covariance(n: int) -> jax.Array:
    root = np.random.default_rng(n).normal(size=(n, n)) * 0.05
    return f32(root @ root.T + 1e-3 * np.eye(n))


def belief(name: str) -> GaussianBelief:
    if name == "planar":
        return planar_belief(f32([0.4, -0.7, 2.9]), covariance(3))
    if name == "planar with a rest":
        return GaussianBelief(RestState(f32([0.4, -0.7, 2.9]), f32([0.5, -0.2])), covariance(5), WithRest(PLANAR, 2))
    rng = np.random.default_rng(0)
    return rigid_belief(RigidState(se3_exp(f32(rng.normal(size=6))), f32(rng.normal(size=6))), covariance(12))


def tiny_map(storage: str) -> VoxelMap | None:
    """Return two blocks of 8^3 cells; the second is observed near the surface, far from it, and not at all."""
    if storage == "none":
        return None
    rng = np.random.default_rng(1)
    m = VoxelMap.prior((0.0, 0.0, 0.0), CELL, (16, 8, 8), slots=None if storage == "dense" else 4)
    cells = m.occupancy.shape[1]
    third = np.arange(cells) % 3
    rows = {
        "occupancy": np.where(third == 0, rng.uniform(-0.15, 0.15, cells), np.where(third == 1, 0.9, -0.001)),
        "occupancy_precision": np.where(third == 2, PRIOR_OCCUPANCY_STD**-2, PRECISION),
        "colour": rng.uniform(0.1, 0.9, (3, cells)),
        "colour_precision": np.where(third == 0, PRECISION, PRIOR_OCCUPANCY_STD**-2),
    }
    arrays = [getattr(m, name).at[1].set(f32(row)) for name, row in rows.items()]
    m = eqx.tree_at(lambda m: [getattr(m, name) for name in rows], m, arrays)
    if m.table is not None:  # slot 1 holds block 1
        m = eqx.tree_at(lambda m: m.table, m, BlockTable.of(m.blocks, 4, np.array([1])))
    return m.with_occupancy(m.occupancy)


EVERY = [
    (kind, storage) for kind in ("planar", "planar with a rest", "rigid") for storage in ("none", "dense", "sparse")
]
every = pytest.mark.parametrize(("kind", "storage"), EVERY)


def walk() -> PoseErrors:
    """Return errors of two keyframes, some centimetres."""
    T = np.tile(np.eye(4), (2, 1, 1))
    return PoseErrors.of(T, np.stack([1e-3 * np.eye(6), 2e-3 * np.eye(6)]), Camera.from_hfov(16, 12, 1.0))


def made(kind: str, storage: str) -> Posterior:
    return Posterior(belief(kind), tiny_map(storage))


def assert_same(actual: Any, expected: Any) -> None:
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


# --- samples and densities


@every
def test_a_draw_is_a_state_and_a_map(kind: str, storage: str) -> None:
    posterior = made(kind, storage)
    draw = posterior.sample(jax.random.key(0))
    assert jax.tree.map(jnp.shape, draw.state) == jax.tree.map(jnp.shape, posterior.belief.mean)
    assert (draw.map is None) == (storage == "none")
    assert_same(posterior.sample(jax.random.key(0)), draw)
    terms = posterior.log_prob(draw)
    np.testing.assert_allclose(float(terms.state), float(posterior.belief.log_prob(draw.state)), rtol=1e-5)
    none = jax.tree.map(jnp.zeros_like, draw.coefficients)
    at_mean = posterior.log_prob(draw._replace(state=posterior.belief.mean, coefficients=none))
    assert float(at_mean.state) > float(terms.state)
    assert float(at_mean.map) > float(terms.map) if draw.map else float(at_mean.map) == float(terms.map) == 0.0


@pytest.mark.parametrize("storage", ["dense", "sparse"])
def test_the_maps_density_belongs_to_its_samples(storage: str) -> None:
    """``log N(0, 1)`` of every coefficient, and these coefficients make the map of the draw."""
    posterior = eqx.tree_at(lambda p: p.map.pose_errors, made("planar", storage), walk(), is_leaf=lambda x: x is None)
    draw = posterior.sample(jax.random.key(1))
    assert draw.map is not None
    assert draw.coefficients is not None
    e = np.concatenate([np.asarray(a, float).ravel() for a in draw.coefficients])
    assert e.size == 6 * 256 + 2 * 6
    np.testing.assert_allclose(float(posterior.log_prob(draw).map), norm.logpdf(e).sum(), rtol=1e-5)
    again = deform(posterior.map, draw.coefficients, posterior.measurement_noise)
    np.testing.assert_allclose(np.asarray(again.occupancy), np.asarray(draw.map.occupancy), atol=1e-6)
    exact = replace(posterior.map, pose_errors=None)
    true = deform(exact, draw.coefficients._replace(poses=jnp.zeros((0, 6))))
    assert np.abs(np.asarray(true.occupancy) - np.asarray(draw.map.occupancy)).max() > 1e-3


@every
def test_entropies_are_those_of_the_parts(kind: str, storage: str) -> None:
    """The map's entropy falls by ``1/2 log(precision / prior)`` nats with every observed cell."""
    posterior = made(kind, storage)
    entropy = posterior.entropy()
    assert entropy.state == pytest.approx(float(posterior.belief.entropy()))
    if posterior.map is None:
        assert entropy.map == 0.0
        return
    observed = int((np.asarray(posterior.map.occupancy_precision) > 1.0).sum())
    assert observed > 300
    expected = -0.5 * observed * np.log(PRECISION * PRIOR_OCCUPANCY_STD**2)
    assert entropy.map == pytest.approx(expected, rel=1e-5) == map_entropy(posterior.map)


class Either(eqx.Module):
    """Mix two Gaussians, half of each."""

    a: GaussianBelief
    b: GaussianBelief

    @property
    def mean(self) -> Float[Array, "3"]:
        return self.a.mean

    def sample(self, key: PRNGKeyArray, samples: int) -> Float[Array, "n 3"]:
        which, by_a, by_b = jax.random.split(key, 3)
        first = jax.random.bernoulli(which, 0.5, (samples, 1))
        return jnp.where(first, self.a.sample(by_a, samples), self.b.sample(by_b, samples))

    def log_prob(self, state: Array) -> Array:
        return jnp.logaddexp(self.a.log_prob(state), self.b.log_prob(state)) - jnp.log(2.0)

    def entropy(self) -> Array:
        drawn = self.sample(jax.random.key(0), 1000)
        return -self.log_prob(drawn).mean()


def test_a_mixture_can_be_a_belief(tmp_path: Path) -> None:
    """A belief over two places is sampled and scored, but only a Gaussian is saved."""
    near = planar_belief(f32([0.0, 0.0, 0.0]), 1e-4 * jnp.eye(3))
    far = planar_belief(f32([5.0, 0.0, 0.0]), 1e-4 * jnp.eye(3))
    mixed = Either(near, far)
    assert isinstance(mixed, Belief)
    posterior = Posterior(mixed, None)
    x = [float(posterior.sample(jax.random.key(seed)).state[0]) for seed in range(40)]
    assert 5 < sum(value > 2.5 for value in x) < 35
    draw = posterior.sample(jax.random.key(0))
    nearer = near if float(draw.state[0]) < 2.5 else far
    expected = float(nearer.log_prob(draw.state)) - np.log(2.0)
    assert float(posterior.log_prob(draw).state) == pytest.approx(expected, abs=1e-4)
    assert posterior.entropy().state == pytest.approx(float(near.entropy()) + np.log(2.0), abs=0.2)
    with pytest.raises(InputError, match="belief: expected a Gaussian"):
        posterior.save(tmp_path / "mixed.npz")
    assert not list(tmp_path.iterdir())


# --- files


@every
def test_saved_posteriors_are_read_back(tmp_path: Path, kind: str, storage: str) -> None:
    posterior, path = made(kind, storage), tmp_path / "posterior.npz"
    posterior.save(path, sequence="room", frames=7)
    again = Posterior.load(path)
    assert again.belief.manifold == posterior.belief.manifold  # type: ignore[attr-defined]
    assert_same(again.belief, posterior.belief)
    if posterior.map is None:
        assert again.map is None
        with pytest.raises(InputError, match="version"):
            VoxelMap.load(path)
    else:
        assert again.map is not None
        for name in ("occupancy", "occupancy_precision", "colour", "colour_precision"):
            laid_out = [np.asarray(m.dense(getattr(m, name))) for m in (again.map, posterior.map)]
            np.testing.assert_array_equal(*laid_out)
        assert_same(VoxelMap.load(path), again.map)  # a map file, to whoever wants the map alone
        assert map_file.read_metadata(path)["frames"] == 7
    twice = tmp_path / "again.npz"
    again.save(twice, sequence="room", frames=7)
    assert twice.read_bytes() == path.read_bytes()


def test_errors_of_poses_are_saved_with_the_map(tmp_path: Path) -> None:
    path = tmp_path / "posterior.npz"
    Posterior(belief("planar"), replace(tiny_map("dense"), pose_errors=walk())).save(path)
    for again in (Posterior.load(path).map, VoxelMap.load(path)):
        assert again is not None
        assert again.pose_errors is not None
        np.testing.assert_allclose(np.asarray(again.pose_errors.root), np.asarray(walk().root), rtol=1e-6)
    made("planar", "dense").save(path)
    assert VoxelMap.load(path).pose_errors is None


def assert_refused(path: Path, field: str = "") -> None:
    with pytest.raises(InputError) as raised:
        Posterior.load(path)
    assert raised.value.source == str(path)
    assert raised.value.field.startswith(field)
    assert "\n" not in str(raised.value)


def test_files_without_a_belief_are_refused(tmp_path: Path) -> None:
    m = tiny_map("dense")
    assert m is not None
    m.save(tmp_path / "map.npz")
    assert_refused(tmp_path / "map.npz", "belief")
    assert_refused(tmp_path / "none.npz", "file")
    assert_refused(tmp_path, "file")
    for content in (b'{"format": "other"}', b'{"format": []}', b'{"format": {}}', b"[]"):
        np.savez(tmp_path / "other.npz", header=np.frombuffer(content, np.uint8))
        assert_refused(tmp_path / "other.npz", "format")


CHANGES = {
    "manifold": ("manifold", "sphere"),
    "manifold, a list": ("manifold", []),
    "mean, too short": ("mean", [[1.0, 2.0]]),
    "mean, none": ("mean", None),
    "mean, beyond float64": ("mean", [[10**400, 0.0, 0.0]]),
    "mean, beyond float32": ("mean", [[1e300, 0.0, 0.0]]),
    "rest, negative": ("rest", -1),
    "rest, a word": ("rest", "2"),
    "rest, too large": ("rest", 10**9),
    "covariance, not finite": ("covariance", [[float("nan")] * 3] * 3),
    "covariance, words": ("covariance", [["a"] * 3] * 3),
    "covariance, of another state": ("covariance", np.eye(12).tolist()),
    "covariance, not symmetric": ("covariance", [[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "covariance, negative": ("covariance", (-np.eye(3)).tolist()),
}


def header_of(path: Path) -> dict:
    with np.load(path, allow_pickle=False) as stored:
        return json.loads(stored["header"].tobytes())


def with_header(path: Path, header: Any) -> None:
    with np.load(path, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)


@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("storage", ["none", "dense"])
def test_an_invalid_belief_is_refused(tmp_path: Path, storage: str, name: str) -> None:
    path = tmp_path / "posterior.npz"
    made("planar", storage).save(path)
    header = header_of(path)
    field, value = CHANGES[name]
    with_header(path, header | {"belief": header["belief"] | {field: value}})
    no_number = name in ("mean, beyond float64", "covariance, not finite")  # refused by the reader of JSON
    assert_refused(path, "header" if no_number else f"belief.{field}")


def test_a_later_version_is_refused(tmp_path: Path) -> None:
    for storage in ("none", "dense"):
        path = tmp_path / f"{storage}.npz"
        made("planar", storage).save(path)
        with_header(path, header_of(path) | {"version": 99})
        assert_refused(path, "version")


@given(st.data())
def test_a_damaged_file_is_refused_or_loads_a_valid_posterior(tmp_path_factory: Any, data: st.DataObject) -> None:
    """Headers with parts removed or replaced by nonsense, and bytes cut, overwritten or repeated."""
    path = tmp_path_factory.mktemp("posterior") / "posterior.npz"
    made("planar", "none").save(path)
    if data.draw(st.booleans()):
        with_header(path, data.draw(damaged_json(header_of(path))))
    else:
        path.write_bytes(data.draw(damaged_bytes(path.read_bytes())))
    try:
        posterior = Posterior.load(path)
    except InputError as error:
        assert error.source == str(path)
        assert "\n" not in str(error)
        return
    draw = posterior.sample(jax.random.key(0))
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(draw))


def test_no_pickle_is_written_or_read(tmp_path: Path) -> None:
    path = tmp_path / "posterior.npz"
    made("rigid", "sparse").save(path)
    with zipfile.ZipFile(path) as archive:
        assert all(name.endswith(".npy") for name in archive.namelist())
    with np.load(path, allow_pickle=False) as stored:
        assert all(stored[name].dtype != object for name in stored.files)
    np.savez(path, header=np.array({"format": "vssm_gym.Belief"}, object))
    assert_refused(path, "file")
