"""Test that depth pixels take the colour of their points, and that two cameras are read or refused."""

import json
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from tests.helpers.slam_recordings import CAMERA
from tests.inference.smoothing.colour_room import ROOM, STATED, THETA, TRUE, images, true_pose, write_unregistered
from vssm_gym.data.distortion import reach
from vssm_gym.data.intrinsics import ColourCalibration
from vssm_gym.data.recording import record_handheld
from vssm_gym.data.registration import Registration
from vssm_gym.data.sequences import FrameReader, SequenceWriter, load_sequence
from vssm_gym.envs.sensors import CameraConfig
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.colour_camera import PRIOR_STD, ColourCamera

LENS = np.array([0.1, -0.05, 0.002, -0.001, 0.01])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_unregistered(tmp_path / "room", 2)


def test_a_depth_pixel_is_found_where_its_point_projects() -> None:
    """Against the projection written out for single pixels, in float64, with the colour camera's lens."""
    depth = np.random.default_rng(0).uniform(1.0, 3.0, (CAMERA.height, CAMERA.width))
    u, v, known = Registration(CAMERA, ColourCalibration(TRUE, LENS))(depth)
    T = np.linalg.inv(np.asarray(TRUE.T_depth_colour, np.float64))
    k1, k2, p1, p2, k3 = LENS
    for row, column in ((30, 40), (10, 70), (50, 12)):
        p = depth[row, column] * np.linalg.inv(CAMERA.K) @ (column, row, 1.0)
        x, y, z, _ = T @ (*p, 1.0)
        x, y = x / z, y / z
        r2 = x * x + y * y
        radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        bent = (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            1.0,
        )
        expected = TRUE.camera.K @ bent
        np.testing.assert_allclose((u[row, column], v[row, column]), expected[:2], atol=1e-9)
    assert known.any()


def test_a_point_outside_of_the_colour_image_has_no_colour() -> None:
    narrow = ColourCamera(Camera(40, 30, 64.0, 64.0, 19.5, 14.5), np.eye(4))
    _, _, known = Registration(CAMERA, ColourCalibration(narrow))(np.full((60, 80), 2.0))
    x, y = (np.arange(80) - CAMERA.cx) / CAMERA.fx, (np.arange(60) - CAMERA.cy) / CAMERA.fy
    expected = (np.abs(y) <= 14.5 / 64.0)[:, None] & (np.abs(x) <= 19.5 / 64.0)
    np.testing.assert_array_equal(known, expected)


def test_a_barrel_lens_shows_nothing_twice() -> None:
    """Beyond the radius at which its distortion turns back, points would appear in the middle again."""
    barrel = np.array([-0.3, 0.0, 0.0, 0.0, 0.0])
    assert reach(barrel) == pytest.approx((1.0 / 0.9) ** 0.5)
    assert reach(np.zeros(5)) == np.inf
    wide, colour = (
        Camera.from_hfov(160, 120, np.radians(130.0)),
        ColourCamera(Camera.from_hfov(160, 120, 1.2), np.eye(4)),
    )
    _, _, known = Registration(wide, ColourCalibration(colour, barrel))(np.full((120, 160), 2.0))
    x, y = (np.arange(160) - wide.cx) / wide.fx, (np.arange(120) - wide.cy) / wide.fy
    assert known.any() and not known[np.hypot(*np.meshgrid(x, y)) > reach(barrel)].any()


@pytest.mark.parametrize("size", [(160, 120), (2000, 12)])
def test_a_long_lens_is_read(tmp_path: Path, size: tuple[int, int]) -> None:
    """Averages of blocks never leave less than a few of them."""
    folder = write_unregistered(tmp_path / "room", 1)
    meta = json.loads((folder / "camera.json").read_text())
    meta["colour"] |= {"width": size[0], "height": size[1]}
    meta["colour"]["K"] = [[30000.0, 0.0, size[0] / 2], [0.0, 30000.0, size[1] / 2], [0.0, 0.0, 1.0]]
    (folder / "camera.json").write_text(json.dumps(meta))
    for path in (folder / "rgb").iterdir():
        iio.imwrite(path, np.full((size[1], size[0], 3), 90, np.uint8))
    rgb, _ = FrameReader(load_sequence(folder), (80, 60))[0]
    assert (rgb == 90).all()


def test_intrinsics_do_not_replace_two_calibrations(folder: Path) -> None:
    with pytest.raises(InputError, match="both cameras"):
        load_sequence(folder, (60.0, 60.0, 39.5, 29.5))


def test_a_covered_point_has_no_colour() -> None:
    """A board before a wall: from 10 cm to the right it covers what the depth camera sees on the board's left."""
    depth = np.full((60, 80), 3.0)
    depth[20:40, 30:50] = 1.0
    beside = np.eye(4)
    beside[0, 3] = 0.1
    _, _, known = Registration(CAMERA, ColourCalibration(ColourCamera(CAMERA, beside)))(depth)
    shift = CAMERA.fx * 0.1 * (1.0 - 1.0 / 3.0)  # pixels that the board moves before the wall
    strip = ~known[22:38, 15:30]
    assert np.all(strip[:, -int(shift) + 1 :])
    assert not strip[:, : 15 - int(shift) - 3].any()
    assert known[20:40, 30:50].all()
    assert known[22:38, 50:].all()


def test_colours_are_those_of_the_surfaces(folder: Path) -> None:
    """With the true calibration the registered image is the one that a camera in the depth camera's place takes."""
    sequence = load_sequence(folder)
    expected = 255.0 * np.asarray(ROOM.image(true_pose(1), CAMERA).rgb)
    errors = []
    for view in (STATED, TRUE):
        rgb, depth = FrameReader(replace(sequence, colour=ColourCalibration(view)))[1]
        assert (depth > 0.0).mean() > 0.8
        errors.append(np.median(np.abs(rgb - expected)[depth > 0.0]))
    assert errors[1] < 0.25 * errors[0]
    assert errors[1] < 2.0


def test_one_camera_twice_registers_pixel_by_pixel(tmp_path: Path) -> None:
    rng, depth = np.random.default_rng(0), np.full((60, 80), 2.0)
    rgb = rng.integers(0, 255, (60, 80, 3), dtype=np.uint8)
    for name, colour in (("one", None), ("two", ColourCalibration(ColourCamera(CAMERA, np.eye(4))))):
        writer = SequenceWriter(tmp_path / name, CAMERA, np.eye(4), controls=False, colour=colour)
        writer.append(0.0, rgb, depth, np.eye(4))
        writer.close()
    (one, z_one), (two, z_two) = (FrameReader(load_sequence(tmp_path / name))[0] for name in ("one", "two"))
    np.testing.assert_allclose(one[1:-1, 1:-1].astype(int), two[1:-1, 1:-1], atol=1)
    np.testing.assert_array_equal(z_one[1:-1, 1:-1], z_two[1:-1, 1:-1])


def test_images_of_both_cameras_are_read_apart(folder: Path) -> None:
    reader = FrameReader(load_sequence(folder), (40, 30))
    rgb, depth = reader.unregistered(1)
    assert reader.colour is not None
    assert rgb.shape == (reader.colour.camera.height, reader.colour.camera.width, 3) == (27, 40, 3)
    assert depth.shape == (30, 40)
    exact, _ = images(1)
    assert abs(float(rgb.mean()) - float(exact.mean())) < 2.0


# --- camera.json -----------------------------------------------------------------------------------------------------


def test_a_calibration_survives_a_file(tmp_path: Path) -> None:
    std = np.linspace(0.001, 0.01, 10)
    stated = ColourCalibration(TRUE, LENS, std)
    writer = SequenceWriter(tmp_path / "s", CAMERA, np.eye(4), controls=False, colour=stated)
    writer.append(0.0, *images(0), np.eye(4))
    writer.close()
    read = load_sequence(tmp_path / "s").colour
    assert read is not None
    assert read.view.camera == TRUE.camera
    np.testing.assert_array_equal(read.view.T_depth_colour, TRUE.T_depth_colour)
    np.testing.assert_array_equal(read.distortion, LENS)
    np.testing.assert_array_equal(read.std, std)


def test_what_is_not_stated_has_a_default(folder: Path) -> None:
    stored = json.loads((folder / "camera.json").read_text())
    for name in ("T_depth_colour", "std", "distortion"):
        del stored["colour"][name]
    (folder / "camera.json").write_text(json.dumps(stored))
    read = load_sequence(folder).colour
    assert read is not None
    np.testing.assert_array_equal(read.view.T_depth_colour, np.eye(4))
    np.testing.assert_array_equal(read.std, PRIOR_STD)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width", 0),
        ("height", "tall"),
        ("K", [[0, 0, 47], [0, 63, 32], [0, 0, 1]]),
        ("K", [[64, 0, 470], [0, 63, 320], [0, 0, 1]]),
        ("distortion", [0.1]),
        ("T_depth_colour", [1.0]),
        ("T_depth_colour", [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]]),
        ("std", [0.1] * 9),
        ("std", [0.1] * 9 + [-0.1]),
        ("std", [0.1] * 9 + [0.0]),
        ("std", "small"),
    ],
)
def test_an_impossible_colour_camera_is_refused(folder: Path, field: str, value: object) -> None:
    path = folder / "camera.json"
    stored = json.loads(path.read_text())
    stored["colour"][field] = value
    path.write_text(json.dumps(stored))
    with pytest.raises(InputError) as caught:
        load_sequence(folder)
    assert (caught.value.source, caught.value.field) == (str(path), f"colour.{field}")


@pytest.mark.parametrize("value", [3, [], {"width": 96, "height": 64}])
def test_a_colour_camera_without_its_fields_is_refused(folder: Path, value: object) -> None:
    path = folder / "camera.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"colour": value}))
    with pytest.raises(InputError, match="T_depth_colour") as caught:
        load_sequence(folder)
    assert caught.value.field == "colour"


def test_colour_images_of_another_size_are_refused(folder: Path) -> None:
    for path in (folder / "rgb").iterdir():
        iio.imwrite(path, np.zeros((32, 48, 3), np.uint8))
    with pytest.raises(InputError, match=r"the colour images' size, 48x32; found 96x64"):
        load_sequence(folder)


def test_two_sizes_need_two_cameras(folder: Path) -> None:
    path = folder / "camera.json"
    stored = json.loads(path.read_text())
    del stored["colour"]
    path.write_text(json.dumps(stored))
    with pytest.raises(InputError, match=r"state the field colour in camera\.json"):
        load_sequence(folder)


# --- record ----------------------------------------------------------------------------------------------------------


def test_record_states_what_is_wrong_and_keeps_the_truth_apart(tmp_path: Path) -> None:
    for colour in ("registered", "unregistered"):
        camera = CameraConfig(80, 60)
        record_handheld("fern", tmp_path / colour, metres=0.1, camera=camera, colour=colour, sensor_noise="kinect")
    stated = load_sequence(tmp_path / "unregistered").colour
    truth = json.loads((tmp_path / "unregistered" / "calibration_truth.json").read_text())["colour"]
    assert stated is not None
    true = ColourCamera(Camera.from_matrix(np.array(truth["K"]), 80, 60), np.array(truth["T_depth_colour"]))
    theta = stated.view.difference(true)
    assert abs(np.linalg.norm(true.T_depth_colour[:3, 3]) - 0.025) < 0.003
    assert 0.001 < np.linalg.norm(theta[3:6]) < np.radians(3.0)
    np.testing.assert_allclose(np.abs(np.expm1(theta[6:8])), 0.02, atol=5e-4)
    depths = [sorted((tmp_path / colour / "depth").iterdir()) for colour in ("registered", "unregistered")]
    for one, other in zip(*depths, strict=True):
        assert one.read_bytes() == other.read_bytes()  # the depth camera does not know of the other one
    assert not (tmp_path / "registered" / "calibration_truth.json").exists()


def test_a_difference_of_calibrations_undoes_a_change() -> None:
    np.testing.assert_allclose(STATED.difference(TRUE), THETA, atol=1e-6)
