"""Test recorded sequences: round trip, lenses, sizes, and one clear error for every broken folder."""

import json
import os
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from tests.helpers.analytic_room import camera_pose
from vssm_gym.data.images import colour_image, depth_image
from vssm_gym.data.sequences import DEPTH_SCALE, FrameReader, SequenceWriter, distort, load_sequence
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera

CAMERA = Camera.from_hfov(16, 12, 1.2)
T_BODY_CAM = camera_pose((0.0, 0.0, 0.4), 0.0)
FRAMES = 4


def frame(i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return colour, depth (with a hole), pose and command of frame i."""
    rng = np.random.default_rng(i)
    depth = rng.uniform(0.3, 8.0, (12, 16)).astype(np.float32)
    depth[3, 4] = 0.0
    rgb = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    return rgb, depth, camera_pose((0.1 * i, 0.2, 0.4), 0.3 * i), np.array([0.05, -0.01, 0.1]) * i


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = tmp_path / "sequence"
    writer = SequenceWriter(root, CAMERA, T_BODY_CAM)
    for i in range(FRAMES):
        rgb, depth, T_world_cam, control = frame(i)
        writer.append(0.2 * i, rgb, depth, T_world_cam, control)
    writer.close()
    return root


def assert_refused(path: Path | str, field: str, call) -> None:
    """Assert one clear error that names the file and the field."""
    with pytest.raises(InputError) as caught:
        call()
    assert caught.value.source == str(path)
    assert caught.value.field == field
    assert "\n" not in str(caught.value)


def read_all(root: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    reader = FrameReader(load_sequence(root))
    return [reader[i] for i in range(len(reader))]


# --- what is written is what is read ---------------------------------------------------------------------------------


def test_round_trip(folder: Path) -> None:
    """Colour exactly, depth to half a unit of 0.2 mm, poses and commands to their printed digits."""
    sequence = load_sequence(folder)
    np.testing.assert_allclose(sequence.times, 0.2 * np.arange(FRAMES))
    assert sequence.camera == CAMERA
    assert sequence.depth_scale == DEPTH_SCALE
    np.testing.assert_array_equal(sequence.distortion, 0.0)
    np.testing.assert_allclose(sequence.T_body_cam, T_BODY_CAM)
    reader = FrameReader(sequence)
    assert len(reader) == FRAMES
    poses = sequence.true_poses()
    for i in range(FRAMES):
        rgb, depth, T_world_cam, control = frame(i)
        read_rgb, read_depth = reader[i]
        np.testing.assert_array_equal(read_rgb, rgb)
        np.testing.assert_allclose(read_depth, depth, atol=0.5 / DEPTH_SCALE + 1e-6)
        assert read_depth.dtype == np.float32
        assert read_depth[3, 4] == 0.0
        np.testing.assert_allclose(poses[i], T_world_cam, atol=1e-6)
        np.testing.assert_allclose(sequence.controls[i], [0.2 * i, *control], atol=1e-6)


def test_depths_that_do_not_fit_are_no_reading(tmp_path: Path) -> None:
    """16 bits at 5000 units a metre end at 13.1 m; a wrapped value would be a wall that is not there."""
    writer = SequenceWriter(tmp_path / "s", CAMERA, T_BODY_CAM)
    rgb, depth, T, control = frame(0)
    depth[0, :5] = [13.0, 13.2, 100.0, np.inf, np.nan]
    writer.append(0.0, rgb, depth, T, control)
    writer.close()
    ((_, read),) = read_all(tmp_path / "s")
    np.testing.assert_allclose(read[0, :5], [13.0, 0.0, 0.0, 0.0, 0.0], atol=1e-4)


def test_a_recording_is_never_overwritten(folder: Path) -> None:
    assert_refused(folder, "folder", lambda: SequenceWriter(folder, CAMERA, T_BODY_CAM))
    assert_refused(folder / "rgb.txt", "folder", lambda: SequenceWriter(folder / "rgb.txt", CAMERA, T_BODY_CAM))


def test_an_unfinished_recording_is_not_a_sequence(tmp_path: Path) -> None:
    """``camera.json`` comes last."""
    writer = SequenceWriter(tmp_path / "s", CAMERA, T_BODY_CAM)
    writer.append(0.0, *frame(0))
    for file in writer._files.values():
        file.flush()
    assert_refused(tmp_path / "s" / "camera.json", "file", lambda: load_sequence(tmp_path / "s"))
    writer.close()
    assert len(load_sequence(tmp_path / "s").frames) == 1


# --- broken folders (test_faults.py has those that stop nothing) -----------------------------------------------------


def test_no_folder(tmp_path: Path) -> None:
    assert_refused(tmp_path / "none", "folder", lambda: load_sequence(tmp_path / "none"))


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_grey_and_transparent_images_are_read_as_colour(folder: Path, channels: int) -> None:
    path = sorted((folder / "rgb").iterdir())[2]
    grey = frame(2)[0][..., :1]
    image = {
        1: grey[..., 0],
        2: np.concatenate([grey, 0 * grey + 255], -1),
        4: np.concatenate([grey] * 3 + [0 * grey + 255], -1),
    }
    iio.imwrite(path, image[channels])
    np.testing.assert_array_equal(read_all(folder)[2][0], np.repeat(grey, 3, axis=-1))


@pytest.mark.parametrize(
    ("name", "content", "field"),
    [
        ("associations.txt", "0.0 rgb/0.000000.png 0.0\n", "line 1"),
        ("associations.txt", "# comment\n\nzero rgb/0.000000.png 0.0 depth/0.000000.png\n", "line 3"),
        ("associations.txt", "nan rgb/0.000000.png 0.0 depth/0.000000.png\n", "line 1"),
        ("associations.txt", "# nothing\n", "file"),
        ("associations.txt", b"\xff\xfe\x00", "file"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 1\n1 2 3\n", "line 2"),
        ("groundtruth.txt", "0 0 0 zero 0 0 0 1\n", "line 1"),
        ("controls.txt", "0.0 0.1 0.2 0.3\n0.2 fast 0 0\n", "lines"),
        ("controls.txt", "0.0 0.1 0.2 0.3\n0.2 0.1\n", "lines"),
        ("associations.txt", "0 ../secret.png 0 depth/0.000000.png\n", "images"),
        ("associations.txt", "0 /etc/passwd 0 depth/0.000000.png\n", "images"),
        ("associations.txt", "0 rgb/0\0.png 0 depth/0.000000.png\n", "images"),
        ("groundtruth.txt", "0 1e300 0 0 0 0 0 1\n", "line 1"),
        ("controls.txt", "0.0 0.1 0.2 nan\n", "lines"),
        ("controls.txt", "0.0 0.1 0.2 inf\n", "lines"),
        ("camera.json", "{", "line 1"),
        ("camera.json", "[1, 2]", "content"),
        ("camera.json", "[" * 3000, "content"),
        ("camera.json", b"\xff\xfe\x00", "content"),
    ],
)
def test_a_malformed_line_is_named(folder: Path, name: str, content: str | bytes, field: str) -> None:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    assert_refused(path, field, lambda: load_sequence(folder))


@pytest.mark.parametrize(
    "change",
    [
        {"width": 1e400},
        {"width": 10**400},
        {"width": 8.5},
        {"width": 10**9},
        {"K": [[9, 1, 8], [0, 9, 6], [0, 0, 1]]},
        {"K": [[9, 0, 8], [0, 9, 6], [0, 0, 2]]},
        {"distortion": [0, 0, 0, 0, 1e300]},
        {"depth_scale": 1e-300},
        {"T_body_cam": [[0.0] * 4] * 4},
        {"T_body_cam": [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]]},
        {"T_body_cam": [[-1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        {"T_body_cam": [[1.0, 0, 0, 1e6], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        {"T_body_cam": [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]},
        {"width": None},
        {"width": "wide"},
        {"width": 0},
        {"height": -12},
        {"K": None},
        {"K": [1, 2, 3]},
        {"K": [[0, 0, 8], [0, 9, 6], [0, 0, 1]]},
        {"K": [[float("nan"), 0, 8], [0, 9, 6], [0, 0, 1]]},
        {"distortion": [0.1]},
        {"distortion": [0, 0, 0, 0, float("inf")]},
        {"depth_scale": 0},
        {"depth_scale": -5000},
        {"depth_scale": float("nan")},
        {"T_body_cam": [1.0]},
        {"T_body_cam": [[float("nan")] * 4] * 4},
    ],
)
def test_an_impossible_camera_is_refused(folder: Path, change: dict) -> None:
    path = folder / "camera.json"
    stored = {**json.loads(path.read_text()), **change}
    path.write_text(json.dumps({k: v for k, v in stored.items() if v is not None}))
    (field, value), text = *change.items(), path.read_text()
    assert_refused(path, "content" if value is None or no_json_number(text) else field, lambda: load_sequence(folder))


def no_json_number(text: str) -> bool:
    """Return whether a JSON text has a number that no array holds."""
    return any(word in text for word in ("NaN", "Infinity", "0" * 400))


def test_a_camera_of_another_size_is_refused(folder: Path) -> None:
    """A principal point of 640x480 in a file that states the images' own size."""
    path = folder / "camera.json"
    stored = json.loads(path.read_text()) | {"K": [[525.0, 0, 319.5], [0, 525.0, 239.5], [0, 0, 1]]}
    path.write_text(json.dumps(stored))
    assert_refused(path, "K", lambda: load_sequence(folder))


def test_depth_of_eight_bits_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "depth.png"
    Image.fromarray(np.full((12, 16), 200, np.uint8)).save(path)
    assert_refused(path, "pixels", lambda: depth_image(path, None))


@pytest.mark.parametrize(
    "values", [(1.0,), (1.0,) * 5, (1.0, 1.0, 1.0, float("nan")), (0.0, 9.0, 8.0, 6.0), (-9.0, 9.0, 8.0, 6.0)]
)
def test_impossible_intrinsics_are_refused(folder: Path, values: tuple[float, ...]) -> None:
    assert_refused("--intrinsics", "values", lambda: load_sequence(folder, values))


def test_intrinsics_replace_the_folders_camera(folder: Path) -> None:
    sequence = load_sequence(folder, (9.0, 8.0, 7.0, 6.0, 0.1, 0.2, 0.3, 0.4, 0.5))
    assert sequence.camera == Camera(16, 12, 9.0, 8.0, 7.0, 6.0)
    np.testing.assert_array_equal(sequence.distortion, [0.1, 0.2, 0.3, 0.4, 0.5])
    np.testing.assert_array_equal(load_sequence(folder, (9.0, 8.0, 7.0, 6.0)).distortion, 0.0)


def test_without_ground_truth_a_sequence_still_loads(folder: Path) -> None:
    (folder / "groundtruth.txt").unlink()
    (folder / "controls.txt").unlink()
    sequence = load_sequence(folder)
    assert len(sequence.frames) == FRAMES
    assert len(sequence.controls) == 0
    assert_refused(folder / "groundtruth.txt", "file", sequence.true_poses)


def posed(folder: Path, times: list[float]) -> np.ndarray:
    """Return true poses at 0, 0.2, 0.4 and 0.6 s for a ground truth that moves along x at 1 m/s."""
    (folder / "groundtruth.txt").write_text("".join(f"{t} {t} 0 0 0 0 0 1\n" for t in times))
    return load_sequence(folder).true_poses()[:, 0, 3]


@pytest.mark.parametrize("times", [[0.0, 0.2, 0.4, 0.6], [-0.2, 0.3, 0.7], [0.01, 0.5, 0.59]])
def test_poses_between_near_ones_are_interpolated(folder: Path, times: list[float]) -> None:
    np.testing.assert_allclose(posed(folder, times), np.clip([0.0, 0.2, 0.4, 0.6], times[0], times[-1]), atol=1e-9)


@pytest.mark.parametrize(
    ("times", "at"),
    [
        ([0.05, 0.3, 0.6], "0.000000"),  # begins after the first frame
        ([0.0, 0.3, 0.55], "0.600000"),  # ends before the last one
        ([0.0, 0.75], "0.200000"),  # a gap
        ([-9.0, 9.0], "0.000000"),
        ([5.0], "0.000000"),
    ],
)
def test_frames_without_a_nearby_pose_are_refused(folder: Path, times: list[float], at: str) -> None:
    assert_refused(folder / "groundtruth.txt", "times", lambda: posed(folder, times))
    with pytest.raises(InputError, match=f"the frame at {at} s has none"):
        posed(folder, times)


# --- association and lenses ------------------------------------------------------------------------------------------


def test_frames_are_associated_by_time(folder: Path) -> None:
    """Without ``associations.txt``: the nearest depth image within 20 ms, stamped with the colour image's time."""
    (folder / "associations.txt").unlink()
    depth = [line.split()[1] for line in (folder / "depth.txt").read_text().splitlines()]
    stamps = [0.015, 0.21, 0.43, 0.59]  # of depth; the third is 30 ms off
    (folder / "depth.txt").write_text("".join(f"{t} {name}\n" for t, name in zip(stamps, depth, strict=True)))
    sequence = load_sequence(folder)
    np.testing.assert_allclose(sequence.times, [0.0, 0.2, 0.6])
    assert [f.depth.name for f in sequence.frames] == [Path(depth[i]).name for i in (0, 1, 3)]
    (folder / "depth.txt").write_text(f"9.0 {depth[0]}\n")
    assert_refused(folder, "rgb.txt, depth.txt", lambda: load_sequence(folder))


@pytest.mark.parametrize(
    ("name", "fx"), [("rgbd_dataset_freiburg1_desk", 517.3), ("fr2_xyz", 520.9), ("fr3_office", 535.4)]
)
def test_published_cameras_by_folder_name(folder: Path, name: str, fx: float) -> None:
    """At 16 pixels instead of 640 the focal length is 40 times shorter."""
    (folder / "camera.json").unlink()
    renamed = folder.rename(folder.with_name(name))
    assert load_sequence(renamed).camera.fx == pytest.approx(fx / 40)


def test_distortion_by_hand() -> None:
    """Brown-Conrady at (0.5, -0.2), r2 = 0.29: worked term by term with OpenCV's published formula."""
    k1, k2, p1, p2, k3 = 0.1, -0.05, 0.01, -0.02, 0.03
    radial = 1 + 0.1 * 0.29 - 0.05 * 0.0841 + 0.03 * 0.024389  # 1.02552667
    x = 0.5 * radial + 2 * 0.01 * 0.5 * -0.2 + -0.02 * (0.29 + 2 * 0.25)  # 0.49496334
    y = -0.2 * radial + 0.01 * (0.29 + 2 * 0.04) + 2 * -0.02 * 0.5 * -0.2  # -0.19740533
    assert (x, y) == (pytest.approx(0.494963335), pytest.approx(-0.197405334))
    assert distort(np.array(0.5), np.array(-0.2), np.array([k1, k2, p1, p2, k3])) == (
        pytest.approx(x),
        pytest.approx(y),
    )


@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6))
def test_no_distortion_is_the_identity(x: float, y: float) -> None:
    assert distort(np.array(x), np.array(y), np.zeros(5)) == (x, y)


def lens_sequence(root: Path, distortion: list[float], image: np.ndarray, depth: np.ndarray, camera: Camera) -> Path:
    """Write one frame taken through a lens."""
    writer = SequenceWriter(root, camera, T_BODY_CAM)
    writer.append(0.0, image, depth, np.eye(4), np.zeros(3))
    writer.close()
    stored = json.loads((root / "camera.json").read_text())
    (root / "camera.json").write_text(json.dumps({**stored, "distortion": distortion}))
    return root


def test_undistortion_puts_points_where_the_pinhole_sees_them(tmp_path: Path) -> None:
    """The lens drew the direction's image; undistorted, each pixel shows its own pinhole direction again."""
    camera, k = Camera.from_hfov(160, 120, 1.1), np.array([0.26, -0.9, -0.005, 0.003, 1.1])
    v, u = np.mgrid[0:120, 0:160].astype(float)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    for _ in range(50):  # invert the lens: the undistorted direction that each recorded pixel saw
        dx, dy = distort(x, y, k)
        x, y = x + (u - camera.cx) / camera.fx - dx, y + (v - camera.cy) / camera.fy - dy
    scene = lambda x, y: 128 + 60 * np.sin(9 * x) + 60 * np.cos(8 * y)  # what stands in each direction
    rgb = np.repeat(np.rint(scene(x, y))[..., None], 3, axis=2).astype(np.uint8)
    depth = (2.0 + x + 0.5 * y).astype(np.float32)
    root = lens_sequence(tmp_path / "s", k.tolist(), rgb, depth, camera)
    seen, metres = FrameReader(load_sequence(root))[0]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    inner = (slice(8, -8), slice(8, -8))
    assert np.abs(seen[inner][..., 0] - scene(x, y)[inner]).max() <= 2.5  # grey levels
    assert np.abs(metres[inner] - (2.0 + x + 0.5 * y)[inner]).max() < 1.0 / camera.fx  # nearest: within half a pixel
    assert np.abs(rgb[inner][..., 0] - scene(x, y)[inner]).max() > 10  # the lens did matter


@pytest.mark.parametrize("size", [(160, 120), (80, 60), (53, 40), (40, 30), (20, 15)])
def test_resizing_keeps_the_view(tmp_path: Path, size: tuple[int, int]) -> None:
    """A linear picture and a slanted plane look the same at every size, in the resized camera's own coordinates."""
    camera = Camera.from_hfov(160, 120, 1.1)
    v, u = np.mgrid[0:120, 0:160].astype(float)
    slope = lambda c, u, v: 128 + 100 * (u - c.cx) / c.fx - 80 * (v - c.cy) / c.fy
    rgb = np.repeat(np.rint(slope(camera, u, v))[..., None], 3, axis=2).astype(np.uint8)
    depth = (slope(camera, u, v) / 100).astype(np.float32)
    reader = FrameReader(load_sequence(lens_sequence(tmp_path / "s", [0.0] * 5, rgb, depth, camera)), size)
    seen, metres = reader[0]
    v, u = np.mgrid[0 : size[1], 0 : size[0]].astype(float)
    expected = slope(reader.camera, u, v)
    inner = (slice(1, -1), slice(1, -1))
    assert seen.shape == (size[1], size[0], 3)
    assert np.abs(seen[inner][..., 0] - expected[inner]).max() <= 1.5
    # Depth takes one source pixel, at most half a target pixel away along each axis
    assert np.abs(metres - expected / 100).max() < 0.5 * (100 + 80) / 100 / camera.fx + 1e-3


def test_resized_depth_is_a_reading_never_an_average(tmp_path: Path) -> None:
    camera = Camera.from_hfov(160, 120, 1.1)
    depth = np.where(np.indices((120, 160)).sum(0) % 3 == 0, 1.0, 5.0).astype(np.float32)
    root = lens_sequence(tmp_path / "s", [0.0] * 5, np.zeros((120, 160, 3), np.uint8), depth, camera)
    _, metres = FrameReader(load_sequence(root), (53, 40))[0]
    assert set(np.unique(metres)) == {np.float32(1.0), np.float32(5.0)}


# --- a real recording ------------------------------------------------------------------------------------------------


def test_the_tum_recording_loads(shared_data: Path) -> None:
    """freiburg1_xyz: 266 pairs at 10 Hz, a Kinect moved slowly over a desk about 1 m away."""
    sequence = load_sequence(shared_data / "tum_fr1_xyz")
    assert len(sequence.frames) == 266
    assert sequence.times[-1] - sequence.times[0] == pytest.approx(26.6, abs=0.2)
    assert sequence.camera == Camera(320, 240, 258.65, 258.25, 159.3, 127.65)
    assert sequence.T_body_cam is None
    reader = FrameReader(sequence, (160, 120))
    for i in (0, 130, 265):
        rgb, depth = reader[i]
        assert rgb.shape == (120, 160, 3)
        assert 60 < rgb.mean() < 200
        valid = depth[depth > 0]
        assert valid.size > 0.5 * depth.size
        assert 0.5 < np.median(valid) < 2.5
    poses = sequence.true_poses()
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.sum() == pytest.approx(8.0, abs=1.0)  # metres of path, as published
    assert steps.max() < 0.1


def test_a_large_image_is_refused_before_it_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "rgb.png"
    Image.fromarray(np.zeros((5000, 5000), np.uint8)).save(path)
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", lambda *_: pytest.fail("the image was decoded"))
    for size in (None, (16, 12)):
        assert_refused(path, "size", lambda size=size: colour_image(path, size))


def test_an_image_with_a_palette_has_its_colours(tmp_path: Path) -> None:
    colours = np.random.default_rng(0).choice(np.array([[250, 20, 30], [10, 200, 5], [0, 0, 90]], np.uint8), (12, 16))
    Image.fromarray(colours).quantize(3).save(tmp_path / "rgb.png")
    np.testing.assert_array_equal(colour_image(tmp_path / "rgb.png", (16, 12)), colours)


def test_a_pipe_is_no_image(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "rgb.png")
    assert_refused(tmp_path / "rgb.png", "file", lambda: colour_image(tmp_path / "rgb.png", None))
