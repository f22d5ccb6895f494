"""Test recordings and the maps made from them: a complete TUM folder or none, and surfaces at the walls."""

import json

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.box_maps import signed_distance
from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.data.recording import PROVENANCE, read_provenance, record
from vssm_gym.data.sequences import FrameReader, load_sequence
from vssm_gym.envs.scenes.scene import load_scene, save_scene
from vssm_gym.envs.scenes.specs import scene_name
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.maps.cell_centres import cell_centres
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap, read_metadata
from vssm_gym.slam import map_building
from vssm_gym.slam.map_building import build_map, ensure_map, with_exact_surfaces
from vssm_gym.version import package_version

TABLE = furniture("table", (1.5, 2.0, 0.25), (0.6, 0.6, 0.5))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Record two rooms with a table in the west one, driven once with noise."""
    folder = tmp_path_factory.mktemp("recording")
    save_scene(two_rooms(pieces=(TABLE,)), folder / "rooms.json")
    heard = []
    frames = record(
        folder / "rooms.json", folder / "drive", noise="mid", on_progress=lambda *event: heard.append(event)
    )
    return folder / "drive", frames, heard


def test_a_recording_is_a_tum_folder_with_its_provenance(recording):
    folder, frames, heard = recording
    sequence = load_sequence(folder)
    assert len(sequence.frames) == frames == len(sequence.controls)
    np.testing.assert_allclose(np.diff(sequence.times), 0.2, atol=1e-6)
    poses = sequence.true_poses()
    assert sequence.T_body_cam is not None
    np.testing.assert_allclose(poses[:, 2, 3], sequence.T_body_cam[2, 3], atol=1e-6)
    # Both rooms were visited, and noise made the drive differ from its commands.
    assert poses[:, 0, 3].min() < 2.0
    assert poses[:, 0, 3].max() > 4.0
    forward = poses[:-1, :2, 2]
    moved = np.sum((poses[1:, :2, 3] - poses[:-1, :2, 3]) * forward, axis=1)
    assert np.std(moved - sequence.controls[1:, 3]) > 0.005
    made = json.loads((folder / PROVENANCE).read_text())
    assert (made["scene"], made["noise"], made["seed"]) == ("two_rooms", "mid", 0)
    assert read_provenance(folder) == made
    assert heard[-1][0] == "recording"
    assert heard[-1][1] == heard[-1][2] == len(heard)


def test_the_robot_turns_around_at_every_viewpoint(recording):
    """Headings at each viewpoint cover the circle, since the drive turns around there once."""
    poses = load_sequence(recording[0]).true_poses()
    still = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1) < 1e-4
    heading = np.unwrap(np.arctan2(poses[:, 1, 2], poses[:, 0, 2]))
    starts = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])) == 1)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])) == -1)
    circles = sum(heading[end] - heading[start] > 1.7 * np.pi for start, end in zip(starts, ends, strict=True))
    assert circles >= 2


def test_the_same_seed_records_the_same_bytes(recording, tmp_path):
    record(recording[0].parent / "rooms.json", tmp_path / "again", noise="mid")
    for name in ("groundtruth.txt", "controls.txt", "associations.txt", PROVENANCE):
        assert (tmp_path / "again" / name).read_bytes() == (recording[0] / name).read_bytes()
    sequence, again = load_sequence(recording[0]), load_sequence(tmp_path / "again")
    np.testing.assert_array_equal(iio.imread(sequence.frames[40].depth), iio.imread(again.frames[40].depth))


def test_the_commands_of_a_worn_robot_are_not_its_motion(recording, tmp_path):
    """Along its way it makes 85 % of the metres that it is told, and turns 80 % of the angles."""
    camera = CameraConfig(16, 12)
    record(recording[0].parent / "rooms.json", tmp_path / "worn", robot="worn", noise="none", camera=camera)
    sequence = load_sequence(tmp_path / "worn")
    poses, (turns, _, steps) = sequence.true_poses(), sequence.controls[:, 1:].T
    moved = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1).sum()
    turned = np.ptp(np.unwrap(np.arctan2(poses[:, 1, 2], poses[:, 0, 2])))
    assert moved == pytest.approx(0.85 * steps.sum(), rel=0.03)
    assert turned == pytest.approx(0.8 * np.ptp(np.cumsum(turns)), rel=0.1)
    assert read_provenance(tmp_path / "worn")["robot"] == "worn"
    with pytest.raises(InputError, match="robot: expected holonomic, whose commands tell its motion; found worn"):
        build_map(sequence, 0.1, poses="estimated")


def test_a_recording_is_never_overwritten(recording):
    before = (recording[0] / "groundtruth.txt").read_bytes()
    with pytest.raises(InputError, match="folder: expected a new or empty folder"):
        record("oak", recording[0])
    assert (recording[0] / "groundtruth.txt").read_bytes() == before


def test_an_interrupted_recording_leaves_nothing(tmp_path):
    save_scene(two_rooms(), tmp_path / "rooms.json")

    def interrupt(stage, done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(tmp_path / "rooms.json", tmp_path / "drive", on_progress=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["rooms.json"]


def test_an_unknown_scene_or_noise_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(InputError, match="scene"):
        record("baobab", tmp_path / "drive")
    with pytest.raises(InputError, match="noise"):
        record("oak", tmp_path / "drive", noise="loud")
    assert list(tmp_path.iterdir()) == []


def test_a_sequence_without_ground_truth_makes_no_map(recording, tmp_path):
    for path in recording[0].iterdir():
        if path.name != "groundtruth.txt":
            (tmp_path / path.name).symlink_to(path)
    with pytest.raises(InputError, match=r"groundtruth\.txt"):
        build_map(load_sequence(tmp_path), 0.1)


def test_cells_too_small_for_memory_are_refused(recording):
    with pytest.raises(InputError, match="voxel: expected larger cells"):
        build_map(load_sequence(recording[0]), 0.005)


@pytest.mark.slow
def test_the_map_has_its_surfaces_where_the_walls_are(recording):
    """Faces are at x = 0.05 (west wall), 2.95 and 3.05 (wall between the rooms), the table's top at 0.5 m."""
    sequence = load_sequence(recording[0])
    voxel_map = build_map(sequence, 0.05)
    low, high = voxel_map.bounds
    reach = np.array([FrameReader(sequence)[i][1].max() for i in range(0, len(sequence.frames), 50)]).max()
    assert np.all(high - low < 2 * reach + 2.0)

    def surfaces(start, end, n=400):
        """Return places along a segment where the mean occupancy changes sign, as distances from its start."""
        start, end = np.array(start), np.array(end)
        t = np.linspace(0.0, 1.0, n)
        occupancy = np.asarray(voxel_map.field(jnp.asarray(start + t[:, None] * (end - start), jnp.float32)))[:, 0]
        changes = np.flatnonzero(np.diff(occupancy > 0.0))
        return t[changes] * np.linalg.norm(end - start)

    np.testing.assert_allclose(surfaces([2.4, 3.3, 0.4], [3.6, 3.3, 0.4]), [0.55, 0.65], atol=0.03)
    np.testing.assert_allclose(surfaces([0.6, 3.3, 0.4], [0.0, 3.3, 0.4])[:1], [0.55], atol=0.03)
    np.testing.assert_allclose(surfaces([1.5, 1.5, 0.3], [1.5, 2.0, 0.3])[:1], [0.2], atol=0.03)
    inside_door = np.asarray(voxel_map.field(jnp.asarray([[3.0, 1.95, z] for z in (0.1, 0.3, 0.5)], jnp.float32)))
    assert np.all(inside_door[:, 0] < 0.0)


@pytest.fixture
def drives(recording, monkeypatch):
    """Make :func:`ensure_map` fast: a recording is a list of its arguments, a map one empty block."""
    made = []

    def record_note(scene, out, *, noise, seed, on_progress):
        out.mkdir()
        (out / PROVENANCE).write_text(json.dumps(read_provenance(recording[0]) | {"noise": noise, "seed": seed}))
        made.append(out)

    monkeypatch.setattr(map_building, "record", record_note)
    monkeypatch.setattr(map_building, "load_sequence", lambda folder: folder)
    monkeypatch.setattr(map_building, "build_map", lambda *_, **__: VoxelMap.prior(np.zeros(3), 0.1, (8, 8, 8)))
    return made


def test_a_map_or_drive_is_used_again_where_all_that_decides_it_agrees_and_never_replaced(recording, drives, tmp_path):
    scene = str(recording[0].parent / "rooms.json")
    path = ensure_map(scene, tmp_path, voxel=0.1, seed=0)
    known, first = read_metadata(path), path.read_bytes()
    assert known["package_version"] == package_version()
    assert ensure_map(scene, tmp_path, voxel=0.1, seed=0).read_bytes() == first
    path.unlink()
    assert ensure_map(scene, tmp_path, voxel=0.1, seed=0).read_bytes() == first
    assert len(drives) == 1
    for field, value in (("renderer", "raycast-other"), ("noise", "high"), ("seed", 5), ("scene_hash", "other")):
        note = tmp_path / "recordings" / "rooms" / PROVENANCE
        before = note.read_text()
        note.write_text(json.dumps(json.loads(before) | {field: value}))
        metadata = {
            key: known[key] for key in ("scene_hash", "seed", "noise", "renderer", "voxel", "poses", "package_version")
        }
        VoxelMap.prior(np.zeros(3), 0.1, (8, 8, 8)).save(path, **metadata | {field: value})
        other = path.read_bytes()
        with pytest.raises(InputError, match=rf"rooms\.npz: {field}: expected a map with .*; found {value}"):
            ensure_map(scene, tmp_path, voxel=0.1, seed=0)
        assert path.read_bytes() == other
        path.unlink()
        with pytest.raises(InputError, match=rf"rooms: {field}: expected a recording with .*; found {value}"):
            ensure_map(scene, tmp_path, voxel=0.1, seed=0)
        assert note.is_file()
        note.write_text(before)
    ensure_map(scene, tmp_path, voxel=0.1, seed=0)
    with pytest.raises(InputError, match=r"rooms\.npz: voxel: expected a map with 0\.2; found 0\.1"):
        ensure_map(scene, tmp_path, voxel=0.2, seed=0)
    with pytest.raises(InputError, match=r"rooms\.npz: surfaces: expected a map with exact; found learned"):
        ensure_map(scene, tmp_path, voxel=0.1, seed=0, surfaces="exact")
    assert len(drives) == 1


@pytest.mark.slow
def test_exact_surfaces_are_those_of_the_scene_where_they_were_seen(recording):
    """Against the distance to the nearest box; what was not observed stays at the prior, and the index follows."""
    apartment = two_rooms(pieces=(TABLE,))
    learned = build_map(load_sequence(recording[0]), 0.1)
    m = with_exact_surfaces(learned, apartment.boxes())
    observed = np.asarray(learned.occupancy_precision) > OBSERVED_PRECISION
    np.testing.assert_array_equal(np.asarray(m.occupancy)[~observed], np.asarray(learned.occupancy)[~observed])
    chosen = np.flatnonzero(observed.ravel())[::97]
    some = np.zeros(observed.size, bool)
    some[chosen] = True
    p = cell_centres(m, some.reshape(observed.shape))
    expected = np.clip(-np.min([signed_distance(box, p) for box in apartment.boxes()], axis=0), -0.2, 0.2)
    np.testing.assert_allclose(np.asarray(m.occupancy).ravel()[chosen], expected, atol=1e-6)
    np.testing.assert_allclose(m.occupancy_at(jnp.asarray(p, jnp.float32)), expected, atol=1e-4)
    np.testing.assert_array_equal(m.colour, learned.colour)
    rebuilt = m.with_occupancy(m.occupancy)
    np.testing.assert_array_equal(m.empty, rebuilt.empty)


@pytest.mark.parametrize(
    ("scene", "name"), [("procedural:3:small", "procedural-3-small"), ("houses.jsonl.gz#4", "houses-4")]
)
def test_a_map_has_the_name_of_its_scene_in_rows(scene, name, recording, drives, monkeypatch, tmp_path):
    """A report finds the map of a row's scene by this name; each house of a file has a map of its own."""
    monkeypatch.setattr(map_building, "load_scene", lambda spec: load_scene(recording[0].parent / "rooms.json"))
    assert ensure_map(scene, tmp_path, voxel=0.1, seed=0) == tmp_path / "maps" / f"{scene_name(scene)}.npz"
    assert drives == [tmp_path / "recordings" / name]


def test_other_files_are_neither_removed_nor_replaced(recording, drives, tmp_path):
    scene = str(recording[0].parent / "rooms.json")
    photos = tmp_path / "recordings" / "rooms"
    photos.mkdir(parents=True)
    (photos / "photo.jpg").write_text("holiday")
    with pytest.raises(InputError, match=r"rooms: scene_hash: expected a recording with .*; found None"):
        ensure_map(scene, tmp_path, voxel=0.1, seed=0)
    assert (photos / "photo.jpg").read_text() == "holiday"
    path = tmp_path / "maps" / "rooms.npz"
    path.parent.mkdir()
    VoxelMap.prior(np.zeros(3), 0.1, (8, 8, 8)).save(path)
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"rooms\.npz: scene_hash: expected a map with .*; found None"):
        ensure_map(scene, tmp_path, voxel=0.1, seed=0)
    assert path.read_bytes() == before
