"""Test the hand-held camera's walk and its recording: collision-free, smooth, long enough, repeatable."""

import json

import numpy as np
import pytest
import shapely
from scipy.spatial.transform import Rotation

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.data.handheld import walk
from vssm_gym.data.recording import read_provenance, record, record_handheld
from vssm_gym.data.sequences import FrameReader, load_sequence
from vssm_gym.data.trajectories import velocities
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import load_scene, save_scene
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError

TABLE = furniture("table", (1.5, 2.0, 0.25), (0.6, 0.6, 0.5))
SMALL = CameraConfig(32, 24)


@pytest.fixture(scope="module", params=["oak", "two_rooms"])
def apartment(request):
    return load_scene(request.param) if request.param == "oak" else two_rooms(pieces=(TABLE,))


@pytest.mark.parametrize("seed", [0, 1])
def test_a_person_around_the_camera_never_collides(apartment, seed):
    """At ten times the frame rate: an upright cylinder of the stated radius, as high as a person, is always free."""
    path = walk(apartment, 40.0, 100.0, seed)
    space = FreeSpace.from_apartment(apartment, path.body, 1.8)
    assert path.body >= 0.2
    assert space.contains(path.T_world_cam[:, :2, 3]).all()
    assert path.T_world_cam[:, 2, 3].min() > 1.0
    assert path.T_world_cam[:, 2, 3].max() < 1.6


def test_corners_are_not_cut_at_any_speed(apartment, monkeypatch):
    """Even without stops to turn, smoothing never leads the path through a wall."""
    monkeypatch.setattr("vssm_gym.data.handheld.SPEED_RANGE", (3.0, 4.0))
    monkeypatch.setattr("vssm_gym.data.handheld.TURN_RATE", 100.0)
    path = walk(apartment, 60.0, 100.0)
    assert FreeSpace.from_apartment(apartment, path.body, 1.8).contains(path.T_world_cam[:, :2, 3]).all()


def test_the_walk_is_as_smooth_as_a_hand_held_camera(apartment):
    """Speed, turn rate and acceleration at 10 Hz are bounded; true velocities follow from the poses."""
    path = walk(apartment, 50.0, 10.0, 3)
    np.testing.assert_allclose(path.times, 0.1 * np.arange(len(path.times)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(path.T_world_cam), 1.0)
    v, w = np.split(velocities(path.times, path.T_world_cam), 2, axis=1)
    speed, turn = np.linalg.norm(v, axis=1), np.degrees(np.linalg.norm(w, axis=1))
    assert 0.1 * speed.sum() == pytest.approx(50.0, abs=0.1)
    assert 0.1 * speed.sum() >= 50.0
    assert speed.max() < 0.7
    assert np.median(speed) > 0.2
    assert 5.0 < np.median(turn) < 30.0
    assert turn.max() < 75.0  # deg/s
    assert np.linalg.norm(np.diff(v, axis=0), axis=1).max() < 0.15  # m/s a frame


def test_the_camera_is_upright_and_faces_its_motion(apartment):
    path = walk(apartment, 30.0, 10.0)
    R = path.T_world_cam[:, :3, :3]
    assert np.degrees(np.arccos(-R[:, 2, 1])).max() < 25.0  # image down against world down
    v = velocities(path.times, path.T_world_cam)[:, :2]
    moving = np.linalg.norm(v, axis=1) > 0.3
    ahead = R[:-1, :2, 2] / np.linalg.norm(R[:-1, :2, 2], axis=1, keepdims=True)
    along = np.sum(ahead * v, axis=1)[moving] / np.linalg.norm(v, axis=1)[moving]
    assert np.median(along) > np.cos(np.radians(25.0))


def test_every_room_is_visited(apartment):
    xy = walk(apartment, 60.0, 10.0).T_world_cam[:, :2, 3]
    for room in apartment.rooms:
        assert shapely.contains_xy(shapely.Polygon(room.polygon), xy).any(), room.name


def test_the_rate_only_sets_the_sampling():
    """Samples at 10 and at 30 Hz lie on the same path."""
    slow, fast = (walk(two_rooms(), 20.0, rate, 5) for rate in (10.0, 30.0))
    n = min(len(slow.times), (len(fast.times) - 1) // 3 + 1) - 1
    np.testing.assert_allclose(slow.T_world_cam[:n], fast.T_world_cam[: 3 * n : 3], atol=6e-3)


def test_impossible_walks_are_refused(tmp_path):
    for metres, rate in ((0.0, 10.0), (np.inf, 10.0), (np.nan, 10.0), (5.0, 0.0), (5.0, 1e6)):
        with pytest.raises(InputError, match="hand-held camera"):
            walk(two_rooms(), metres, rate)
    with pytest.raises(InputError, match="sensor_noise"):
        record_handheld("oak", tmp_path / "r", sensor_noise="loud")
    (tmp_path / "file").write_text("")
    for out in (tmp_path, tmp_path / "file"):
        with pytest.raises(InputError, match="folder: expected a "):
            record_handheld("oak", out, metres=1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_recording_has_the_truth_of_every_frame(tmp_path):
    save_scene(two_rooms(), tmp_path / "rooms.json")
    heard = []
    frames = record_handheld(
        tmp_path / "rooms.json",
        tmp_path / "clean",
        metres=3.0,
        camera=SMALL,
        seed=2,
        on_progress=lambda *event: heard.append(event),
    )
    sequence = load_sequence(tmp_path / "clean")
    path = walk(two_rooms(), 3.0, 10.0, 2)
    assert sequence.notices == ()
    assert len(sequence.frames) == frames == len(path.times)
    np.testing.assert_allclose(sequence.true_poses(), path.T_world_cam, atol=1e-6)
    assert not (tmp_path / "clean" / "controls.txt").exists()
    assert (sequence.camera.width, sequence.camera.height) == (32, 24)
    R = Rotation.from_matrix(sequence.T_body_cam[:3, :3])
    np.testing.assert_allclose(R.apply([0.0, 0.0, 1.0]), [1.0, 0.0, 0.0], atol=1e-9)
    assert heard[-1] == ("recording", frames, frames)
    made = read_provenance(tmp_path / "clean")
    assert (made["motion"], made["metres"], made["sensor_noise"], made["seed"]) == ("handheld", 3.0, "none", 2)

    record_handheld(
        tmp_path / "rooms.json", tmp_path / "noisy", metres=3.0, sensor_noise="kinect", camera=SMALL, seed=2
    )
    noisy = load_sequence(tmp_path / "noisy")
    np.testing.assert_array_equal(noisy.true_poses(), sequence.true_poses())
    (rgb, z), (rgb_noisy, z_noisy) = FrameReader(sequence)[7], FrameReader(noisy)[7]
    assert (z > 0.0).all()
    assert 0.0 < (z_noisy == 0.0).mean() < 0.3
    read = z_noisy > 0.0
    assert 0.0 < np.median(np.abs(z - z_noisy)[read]) < 0.05
    assert 0.0 < np.abs(rgb.astype(float) - rgb_noisy).mean() < 40.0


def test_a_survey_can_be_noisy_too(tmp_path):
    """Noise changes the images and their description, and not the drive."""
    save_scene(two_rooms(), tmp_path / "rooms.json")
    for name in ("none", "stereo"):
        record(tmp_path / "rooms.json", tmp_path / name, sensor_noise=name, camera=SMALL)
    clean, noisy = load_sequence(tmp_path / "none"), load_sequence(tmp_path / "stereo")
    np.testing.assert_array_equal(clean.true_poses(), noisy.true_poses())
    np.testing.assert_array_equal(clean.controls, noisy.controls)
    assert (FrameReader(clean)[3][1] != FrameReader(noisy)[3][1]).mean() > 0.3
    assert json.loads((tmp_path / "stereo" / "recording.json").read_text())["sensor_noise"] == "stereo"
