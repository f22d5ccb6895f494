"""Test the map: interpolation laws, the prior, block storage, and files without pickle."""

import io
import json
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.analytic_room import cell_centres
from tests.helpers.field_oracle import FieldOracle
from tests.helpers.random_maps import ORIGIN, SHAPE, VOXEL, kinds, random_map, seeds
from vssm_gym.errors import InputError
from vssm_gym.maps.voxel_map import (
    PRIOR_COLOUR_STD,
    PRIOR_OCCUPANCY_MEAN,
    PRIOR_OCCUPANCY_STD,
    VoxelMap,
    read_metadata,
)

POINTS = 64
ARRAYS = ("occupancy", "occupancy_precision", "colour", "colour_precision", "origin", "voxel_size")

field, precision = jax.jit(VoxelMap.field), jax.jit(VoxelMap.precision)


def points(seed: int, margin: float = 0.0) -> np.ndarray:
    """Return (POINTS, 3) in the grid, or up to ``margin`` of its size around it; float32 values."""
    extent = VOXEL * (np.array(SHAPE) - 1)
    t = np.random.default_rng(seed).uniform(-margin, 1 + margin, (POINTS, 3))
    return np.asarray(ORIGIN + t * extent, np.float32)


def affine_map(coefficients: np.ndarray) -> VoxelMap:
    """Return a map whose channels are affine: ``coefficients`` (4, 4) of (x, y, z, 1) for occupancy and RGB."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    p = cell_centres(m)
    values = p @ coefficients[:, :3].T + coefficients[:, 3]
    colour = m.blocked(jnp.asarray(values[..., 1:], jnp.float32))
    occupancy = m.blocked(jnp.asarray(values[..., 0], jnp.float32))
    return VoxelMap(
        occupancy, m.occupancy_precision, colour, m.colour_precision, m.empty, m.origin, m.voxel_size, m.blocks
    )


@given(seeds)
def test_the_field_is_exact_on_affine_functions(seed: int) -> None:
    coefficients = np.random.default_rng(seed).uniform(-1.0, 1.0, (4, 4))
    p = points(seed)
    expected = p @ coefficients[:, :3].T + coefficients[:, 3]
    np.testing.assert_allclose(np.asarray(field(affine_map(coefficients), p)), expected, atol=2e-5)


@given(kinds, seeds)
def test_the_field_agrees_with_float64_interpolation(kind: str, seed: int) -> None:
    m, p = random_map(kind, seed), points(seed, margin=0.3)
    g = (p.astype(float) - np.array(ORIGIN)) / VOXEL
    off_the_faces = (np.minimum(np.abs(g), np.abs(g - np.array(SHAPE) + 1)) > 1e-4).all(axis=1)
    expected = FieldOracle.of(m)(p.astype(float))
    scale = float(jnp.abs(m.occupancy).max()) + 1.0
    np.testing.assert_allclose(np.asarray(field(m, p))[off_the_faces], expected[off_the_faces], atol=2e-4 * scale)
    alone = np.asarray(m.occupancy_at(jnp.asarray(p)))
    np.testing.assert_allclose(alone[off_the_faces], expected[off_the_faces, 0], atol=2e-4 * scale)


@given(kinds, seeds)
def test_the_field_stays_between_its_eight_cells(kind: str, seed: int) -> None:
    """The field is a convex combination of the cells, which is why empty boxes can be certified."""
    m, p = random_map(kind, seed), points(seed)
    cells = np.asarray(m.dense(m.occupancy))
    low = np.clip(np.floor((p.astype(float) - np.array(ORIGIN)) / VOXEL), 0, np.array(SHAPE) - 2).astype(int)
    around = np.stack([cells[tuple((low + corner).T)] for corner in np.ndindex(2, 2, 2)])
    value, slack = np.asarray(field(m, p))[:, 0], 1e-4 * (1.0 + np.abs(around).max())
    assert (value >= around.min(axis=0) - slack).all()
    assert (value <= around.max(axis=0) + slack).all()


def test_cells_are_returned_at_their_centres() -> None:
    m = random_map("noise", 1)
    p = jnp.asarray(cell_centres(m)[3:20:4, 1::7, ::5], jnp.float32)
    cells = np.asarray(m.dense(m.occupancy))[3:20:4, 1::7, ::5]
    np.testing.assert_allclose(np.asarray(m.occupancy_at(p)), cells, atol=1e-4)


def test_the_prior() -> None:
    """Std 10 m and 10 in colour, occupancy -0.001, colour 0 (VSSM-LM), inside the grid and beyond it."""
    m = VoxelMap.prior(ORIGIN, VOXEL, SHAPE)
    p = points(0, margin=0.5)
    values, precisions = np.asarray(field(m, p)), np.asarray(precision(m, p))
    np.testing.assert_allclose(values, np.tile([-0.001, 0.0, 0.0, 0.0], (POINTS, 1)))
    np.testing.assert_allclose(precisions, 0.01, rtol=1e-6)
    assert (PRIOR_OCCUPANCY_MEAN, PRIOR_OCCUPANCY_STD, PRIOR_COLOUR_STD) == (-0.001, 10.0, 10.0)
    assert not np.asarray(m.observed_at(jnp.asarray(p))).any()
    assert int(m.empty.level.min()) == 4


def test_beyond_the_grid_the_field_is_the_priors() -> None:
    m = random_map("solid", 0)
    outside = np.array([*np.diag([9.0] * 3), *np.diag([-9.0] * 3)], np.float32)
    np.testing.assert_allclose(np.asarray(m.occupancy_at(jnp.asarray(outside))), PRIOR_OCCUPANCY_MEAN)
    np.testing.assert_allclose(np.asarray(m.precision(jnp.asarray(outside))), 0.01, rtol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1, 1), (8, 8, 8), (9, 16, 17)])
def test_the_grid_is_rounded_up_to_whole_blocks(shape: tuple[int, int, int]) -> None:
    m = VoxelMap.prior((1.0, 2.0, 3.0), 0.5, shape)
    assert m.shape == tuple(-(-n // 8) * 8 for n in shape)
    np.testing.assert_allclose(
        m.bounds, [[1.0, 2.0, 3.0], [0.5 * (n - 1) + o for n, o in zip(m.shape, (1, 2, 3), strict=True)]]
    )


def test_the_published_grid() -> None:
    """200 cells of 7 cm along each axis, centred."""
    m = jax.eval_shape(lambda: VoxelMap.cube((1.0, -2.0, 0.5)))
    assert m.shape == (200, 200, 200)
    small = VoxelMap.cube((1.0, -2.0, 0.5), extent=1.6, voxel_size=0.1)
    np.testing.assert_allclose(small.bounds.mean(axis=0), [1.0, -2.0, 0.5], atol=1e-6)
    np.testing.assert_allclose(np.diff(small.bounds, axis=0), 1.5, atol=1e-6)  # between the centres of 16 cells


@pytest.mark.parametrize("blocks", [(1, 1, 1), (1, 2, 3), (3, 1, 2)])
def test_block_storage_is_a_bijection(blocks: tuple[int, int, int]) -> None:
    m = VoxelMap.prior((0.0, 0.0, 0.0), 0.1, tuple(8 * b for b in blocks))  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    for extra in ((), (3,)):
        dense = jnp.asarray(rng.standard_normal((*m.shape, *extra)))
        stored = m.blocked(dense)
        assert stored.shape == (np.prod(blocks), *extra, 512)
        np.testing.assert_array_equal(m.dense(stored), dense)


def test_observed_share_counts_cells_seen_in_depth_and_colour() -> None:
    """Halfway between an observed and an unobserved cell it is one half; without colour it is zero."""
    m = VoxelMap.prior((0.0, 0.0, 0.0), 1.0, (8, 8, 8))
    grid = np.zeros((8, 8, 8))
    grid[:4] = 1.0
    seen = m.blocked(jnp.asarray(grid + 0.01, jnp.float32))
    p = jnp.array([[2.0, 4.0, 4.0], [3.5, 4.0, 4.0], [3.25, 4.5, 4.5], [5.0, 4.0, 4.0]])
    both = VoxelMap(m.occupancy, seen, m.colour, seen, m.empty, m.origin, m.voxel_size, m.blocks)
    np.testing.assert_allclose(np.asarray(both.observed_at(p)), [1.0, 0.5, 0.75, 0.0])
    grey = VoxelMap(m.occupancy, seen, m.colour, m.colour_precision, m.empty, m.origin, m.voxel_size, m.blocks)
    np.testing.assert_allclose(np.asarray(grey.observed_at(p)), 0.0)


# --- files ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    random_map("blobs", 1).save(tmp_path / "map.npz", scene="oak", frames=7)
    return tmp_path / "map.npz"


@given(kinds, seeds)
def test_save_and_load_keep_every_bit(tmp_path_factory, kind: str, seed: int) -> None:
    path = tmp_path_factory.mktemp("map") / "map.npz"
    m = random_map(kind, seed)
    m.save(path)
    again = VoxelMap.load(path)
    assert again.blocks == m.blocks
    for name in ARRAYS:
        np.testing.assert_array_equal(np.asarray(getattr(again, name)), np.asarray(getattr(m, name)), strict=True)
    np.testing.assert_array_equal(np.asarray(again.empty.level), np.asarray(m.empty.level))
    np.testing.assert_array_equal(np.asarray(again.empty.rings), np.asarray(m.empty.rings))


def test_the_same_map_is_the_same_file(saved: Path) -> None:
    again = saved.with_name("again.npz")
    VoxelMap.load(saved).save(again, scene="oak", frames=7)
    assert again.read_bytes() == saved.read_bytes()


def test_metadata_travels_with_the_map(saved: Path) -> None:
    metadata = read_metadata(saved)
    assert (metadata["scene"], metadata["frames"], metadata["version"]) == ("oak", 7, 1)


def test_no_temporary_file_is_left(saved: Path) -> None:
    assert [p.name for p in saved.parent.iterdir()] == ["map.npz"]


def test_a_failed_save_keeps_the_old_file(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()

    def full_disk(file: io.BufferedWriter, **arrays: np.ndarray) -> None:
        file.write(b"half")
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez_compressed", full_disk)
    with pytest.raises(OSError, match="no space"):
        random_map("solid", 0).save(saved)
    assert saved.read_bytes() == before
    assert [p.name for p in saved.parent.iterdir()] == ["map.npz"]


def rewrite(path: Path, **changes: object) -> None:
    """Change or (with None) drop arrays of a map file."""
    with np.load(path) as stored:
        arrays: dict = {name: stored[name] for name in stored.files}
    arrays.update(changes)
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})


def header(path: Path, **changes: object) -> np.ndarray:
    """Return the header of a map file with some fields changed or (with None) dropped."""
    fields = {**read_metadata(path), **changes}
    return np.frombuffer(json.dumps({k: v for k, v in fields.items() if v is not None}).encode(), np.uint8)


def assert_refused(path: Path, field: str) -> None:
    """Assert one clear error that names the file and the field."""
    with pytest.raises(InputError) as caught:
        VoxelMap.load(path)
    assert caught.value.source == str(path)
    assert caught.value.field == field
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    assert_refused(tmp_path / "none.npz", "file")
    assert_refused(tmp_path, "file")


@given(st.floats(0.0, 0.999))
def test_truncated_file(tmp_path_factory, share: float) -> None:
    path = tmp_path_factory.mktemp("map") / "map.npz"
    random_map("blobs", 1).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    assert_refused(path, "file")


@given(st.floats(0.0, 0.999), st.binary(min_size=1, max_size=40))
def test_a_damaged_file_is_refused_or_loads_the_same_map(tmp_path_factory, share: float, garbage: bytes) -> None:
    """Overwritten bytes are refused, or lie in a field of the zip that nothing reads; they never load another map."""
    path = tmp_path_factory.mktemp("map") / "map.npz"
    m = random_map("blobs", 1)
    m.save(path)
    data = bytearray(path.read_bytes())
    start = int(share * len(data))
    data[start : start + len(garbage)] = garbage
    path.write_bytes(bytes(data))
    try:
        again = VoxelMap.load(path)
    except InputError as error:
        assert error.source == str(path)
    else:
        np.testing.assert_array_equal(np.asarray(again.occupancy), np.asarray(m.occupancy))


@pytest.mark.parametrize("content", [b"", b"hello", b"\x00" * 1000, b"PK\x03\x04" + b"\x01" * 200])
def test_not_a_map(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "map.npz"
    path.write_bytes(content)
    assert_refused(path, "file")


def test_a_single_array_is_not_a_map(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    assert_refused(path, "file")


def test_other_archives_are_not_maps(tmp_path: Path) -> None:
    path = tmp_path / "map.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
    assert_refused(path, "file")
    np.savez(path, occupancy=np.zeros((1, 512)))
    assert_refused(path, "header")


def test_pickles_are_refused(saved: Path) -> None:
    """An object array would run code when it is read, so that nothing of it may be read."""

    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("the pickle was executed",))

    rewrite(saved, colour=np.array([Bomb()], dtype=object))
    assert_refused(saved, "file")


@pytest.mark.parametrize(
    "change", [{"version": 3}, {"version": "1"}, {"version": None}, {"format": "voxels"}, {"format": None}]
)
def test_other_versions_are_refused(saved: Path, change: dict) -> None:
    rewrite(saved, header=header(saved, **change))
    assert_refused(saved, "version")


@pytest.mark.parametrize("content", [b"[1, 2]", b'"map"', b"7"])
def test_an_invalid_header_is_refused(saved: Path, content: bytes) -> None:
    rewrite(saved, header=np.frombuffer(content, np.uint8))
    assert_refused(saved, "version")


@pytest.mark.parametrize("blocks", [None, [3, 3], [3, 3, 0], [3, -3, -2], ["a", 3, 2], "332", [3, 3, 2.5], {"x": 3}])
def test_impossible_blocks_are_refused(saved: Path, blocks: object) -> None:
    rewrite(saved, header=header(saved, blocks=blocks))
    assert_refused(saved, "blocks")


@pytest.mark.parametrize("blocks", [[1000, 1000, 1000], [10**9, 1, 1], [10**400, 1, 1]])
def test_more_blocks_than_any_map_has_are_refused(saved: Path, blocks: list[int]) -> None:
    rewrite(saved, header=header(saved, blocks=blocks))
    assert_refused(saved, "header" if blocks[0] > 10**100 else "blocks")


@pytest.mark.parametrize("slots", [10**8, 0, 2.5, "40", True, None])
def test_slots_that_no_map_has_are_refused(tmp_path: Path, slots: object) -> None:
    path = tmp_path / "map.npz"
    VoxelMap.sparse_cube((0.0, 0.0, 0.0), 1.0, 0.1, slots=5).save(path)
    rewrite(path, header=header(path, slots=slots))
    assert_refused(path, "slots")


def test_a_small_file_that_unpacks_to_gigabytes_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map.npz"
    np.savez_compressed(path, occupancy=np.zeros(3_000_000, np.uint8))
    monkeypatch.setattr("vssm_gym.maps.map_file.MAP_BYTES", 1_000_000)
    monkeypatch.setattr(np, "empty", lambda *_: pytest.fail("memory was asked for"))
    assert_refused(path, "file")


@pytest.mark.parametrize(("name", "value"), [("colour", 1e300), ("occupancy_precision", 1e-300), ("voxel_size", 1e300)])
def test_values_that_float32_does_not_hold_are_refused(saved: Path, name: str, value: float) -> None:
    with np.load(saved) as stored:
        array = np.array(stored[name], np.float64)
    array[...] = value
    rewrite(saved, **{name: array})
    assert_refused(saved, name)


def test_a_map_as_far_as_the_moon_is_refused(saved: Path) -> None:
    rewrite(saved, origin=np.full(3, 3.8e8))
    assert_refused(saved, "origin, voxel_size")


@pytest.mark.parametrize("name", ARRAYS)
def test_missing_arrays_are_named(saved: Path, name: str) -> None:
    rewrite(saved, **{name: None})
    assert_refused(saved, name)


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("bad", ["shape", "nan", "text"])
def test_arrays_that_do_not_fit_are_named(saved: Path, name: str, bad: str) -> None:
    with np.load(saved) as stored:
        array = np.array(stored[name])
    if bad == "shape":
        array = np.zeros((2, *array.shape))
    elif bad == "nan":
        array = np.where(np.arange(array.size).reshape(array.shape) == 0, np.nan, array)
    else:
        array = np.full(array.shape, "one")
    rewrite(saved, **{name: array})
    assert_refused(saved, name)


@pytest.mark.parametrize("name", ["voxel_size", "occupancy_precision", "colour_precision"])
@pytest.mark.parametrize("value", [0.0, -1.0])
def test_sizes_and_precisions_are_positive(saved: Path, name: str, value: float) -> None:
    with np.load(saved) as stored:
        array = np.array(stored[name])
    array.flat[0] = value
    rewrite(saved, **{name: array})
    assert_refused(saved, name)
