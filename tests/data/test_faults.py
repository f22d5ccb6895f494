"""Test faults of recordings: reading continues while a frame is left, and each fault is reported.

What cannot be right anywhere in the folder, such as intrinsics of another size, is refused before any work.
"""

import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.analytic_room import camera_pose
from vssm_gym.data.index import associate_one_to_one
from vssm_gym.data.sequences import FrameReader, SequenceWriter, load_sequence
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera

CAMERA = Camera.from_hfov(16, 12, 1.2)
STEP = 0.1  # s
FRAMES = 8


def colour(i: int) -> np.ndarray:
    return np.full((12, 16, 3), 10 * i + 20, np.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write frames: frame i is 0.1 i s old, of grey 10 i + 20 and 1 + 0.1 i m away."""
    root = tmp_path / "sequence"
    writer = SequenceWriter(root, CAMERA, np.eye(4), controls=False)
    for i in range(FRAMES):
        writer.append(STEP * i, colour(i), np.full((12, 16), 1.0 + 0.1 * i), camera_pose((0.1 * i, 0.0, 0.4), 0.0))
    writer.close()
    return root


def frames_read(root: Path) -> tuple[list[int], tuple[str, ...]]:
    """Return the grey values of the frames read (-2: black), in order, and all notices; depth follows colour."""
    sequence = load_sequence(root)
    reader = FrameReader(sequence)
    numbers = []
    for i in range(len(reader)):
        rgb, depth = reader[i]
        number = (int(rgb[5, 5, 0]) - 20) // 10
        assert depth[5, 5] == pytest.approx(0.0 if number < 0 else 1.0 + 0.1 * number, abs=1e-3)
        numbers.append(number)
    assert (np.diff(sequence.times) > 0.0).all()
    return numbers, (*sequence.notices, *reader.notices)


def lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def assert_notice(notices: tuple[str, ...], *words: str) -> None:
    """Assert one notice, a single line with all of these words."""
    assert len(notices) == 1, notices
    assert "\n" not in notices[0]
    for word in words:
        assert word in notices[0]


def test_a_complete_sequence_has_no_notices(folder: Path) -> None:
    assert frames_read(folder) == (list(range(FRAMES)), ())
    (folder / "associations.txt").unlink()
    assert frames_read(folder) == (list(range(FRAMES)), ())


# --- stamps ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("associated", [True, False])
def test_stamps_out_of_order_are_sorted(folder: Path, associated: bool) -> None:
    index = folder / ("associations.txt" if associated else "rgb.txt")
    if not associated:
        (folder / "associations.txt").unlink()
    rows = lines(index)
    rows[2], rows[5] = rows[5], rows[2]
    index.write_text("\n".join(rows))
    numbers, notices = frames_read(folder)
    assert numbers == list(range(FRAMES))
    assert_notice(notices, index.name, "time runs backwards 2 times", "sorted")


@pytest.mark.parametrize("name", ["associations.txt", "rgb.txt", "depth.txt"])
def test_of_equal_stamps_the_first_counts(folder: Path, name: str) -> None:
    if name != "associations.txt":
        (folder / "associations.txt").unlink()
    rows = lines(folder / name)
    later = rows[4].split()
    later[1::2] = rows[6].split()[1::2]  # frame 4's stamp with frame 6's images
    (folder / name).write_text("\n".join([*rows[:5], " ".join(later), rows[3], *rows[5:]]))
    numbers, notices = frames_read(folder)
    assert numbers == list(range(FRAMES))
    assert any("2 of 10 lines repeat a stamp" in notice and name in notice for notice in notices)


def test_gaps_are_reported(folder: Path) -> None:
    """A gap of 0.8 s between two recorded frames is reported."""
    rows = lines(folder / "associations.txt")
    moved = [
        row.replace(row.split()[0], f"{float(row.split()[0]) + 0.7 * (i > 3):.6f}", 1) for i, row in enumerate(rows)
    ]
    (folder / "associations.txt").write_text("\n".join(moved))
    numbers, notices = frames_read(folder)
    assert numbers == list(range(FRAMES))
    assert_notice(notices, "frames are missing once", "0.80 s", "after 0.300000 s")


def test_slow_recordings_have_no_gaps(folder: Path) -> None:
    """ICL-NUIM counts frames instead of seconds: a regular second between them is no gap."""
    rows = [row.split() for row in lines(folder / "associations.txt")]
    (folder / "associations.txt").write_text("\n".join(f"{i} {row[1]} {i} {row[3]}" for i, row in enumerate(rows)))
    assert frames_read(folder) == (list(range(FRAMES)), ())


# --- images that are not there, or not whole -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["rgb", "depth"])
@pytest.mark.parametrize("associated", [True, False])
def test_frames_of_missing_images_are_left_out(folder: Path, kind: str, associated: bool) -> None:
    if not associated:
        (folder / "associations.txt").unlink()
    images = sorted((folder / kind).iterdir())
    images[2].unlink()
    images[3].unlink()
    numbers, notices = frames_read(folder)
    assert numbers == [0, 1, 4, 5, 6, 7]
    assert "2 of 8 lines name a missing image" in notices[0]
    assert images[2].name in notices[0]
    # Colour without depth is said beside.
    assert len(notices) == (2 if kind == "depth" and not associated else 1)


def test_a_name_that_no_file_can_have_is_that_of_a_missing_image(folder: Path) -> None:
    index = folder / "associations.txt"
    index.write_text(index.read_text().replace("0.100000.png", f"{'x' * 3000}.png", 1))
    numbers, notices = frames_read(folder)
    assert numbers == [0, 2, 3, 4, 5, 6, 7]
    assert_notice(notices, "1 of 8 lines name a missing image")


@pytest.mark.parametrize("associated", [True, False])
def test_no_image_at_all_is_refused(folder: Path, associated: bool) -> None:
    if not associated:
        (folder / "associations.txt").unlink()
    for image in (folder / "depth").iterdir():
        image.unlink()
    with pytest.raises(InputError, match=r"existing files; all 8 are missing, as .*0\.000000\.png") as caught:
        load_sequence(folder)
    assert caught.value.source == str(folder / ("associations.txt" if associated else "depth.txt"))


@pytest.mark.parametrize("kind", ["rgb", "depth"])
@pytest.mark.parametrize("content", [b"", b"not an image", "half", "another size", "another kind"])
@pytest.mark.parametrize("at", [0, 3])
def test_a_damaged_image_makes_an_empty_frame(folder: Path, kind: str, content: bytes | str, at: int) -> None:
    """The frame is black and has no depth, as with a covered camera; the notice names the file."""
    path = sorted((folder / kind).iterdir())[at]
    whole, other = path.read_bytes(), sorted((folder / {"rgb": "depth", "depth": "rgb"}[kind]).iterdir())[at]
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "half":
        path.write_bytes(whole[: len(whole) // 2])
    elif content == "another size":
        iio.imwrite(path, iio.imread(path)[:-1])
    else:
        path.write_bytes(other.read_bytes())
    if (content, at) == ("another size", 0):
        with pytest.raises(InputError, match="size"):  # the first frame says what size the others have
            load_sequence(folder)
        return
    numbers, notices = frames_read(folder)
    assert numbers == [i if i != at else -2 for i in range(FRAMES)]
    assert_notice(notices, str(path), "counts as empty")


def test_a_folder_of_damaged_images_is_refused(folder: Path) -> None:
    for path in (folder / "rgb").iterdir():
        path.write_bytes(b"")
    with pytest.raises(InputError, match="pixels: expected a readable image"):
        load_sequence(folder)


def test_nan_and_negative_depth_are_no_reading(folder: Path) -> None:
    """Depth may be stored as floating-point TIFF, in units of the depth scale."""
    depth = np.full((12, 16), 7500.0, np.float32)
    depth[0, :4] = [np.nan, np.inf, -np.inf, -1.0]
    iio.imwrite(folder / "depth" / "float.tiff", depth)
    for name in ("associations.txt", "depth.txt"):
        rows = lines(folder / name)
        words = rows[1].split()
        words[-1] = "depth/float.tiff"
        (folder / name).write_text("\n".join([rows[0], " ".join(words), *rows[2:]]))
    _, read = FrameReader(load_sequence(folder))[1]
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read[0, :4], 0.0)
    np.testing.assert_allclose(read[0, 4:], 1.5)


# --- sizes -----------------------------------------------------------------------------------------------------------


def test_a_camera_of_another_size_is_refused(folder: Path) -> None:
    stored = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps({**stored, "width": 32, "height": 24}))
    with pytest.raises(InputError, match="width, height: expected the images' size, 16x12; found 32x24") as caught:
        load_sequence(folder)
    assert caught.value.source == str(folder / "camera.json")


@pytest.mark.parametrize("values", [(18.0, 18.0, 15.5, 11.5), (18.0, 18.0, 3.5, 2.5), (18.0, 18.0, 7.5, 300.0)])
def test_intrinsics_of_another_size_are_refused(folder: Path, values: tuple[float, ...]) -> None:
    """A principal point at the edge belongs to images twice as large, or half as large."""
    message = f"middle of the 16x12 images; found cx, cy = {values[2]:g}, {values[3]:g}"
    with pytest.raises(InputError, match=message):
        load_sequence(folder, values)


def test_depth_of_another_size_than_colour_is_refused(folder: Path) -> None:
    for path in (folder / "depth").iterdir():
        iio.imwrite(path, np.zeros((6, 8), np.uint16))
    with pytest.raises(InputError, match=r"the size of 0\.000000\.png, 16x12: depth registered to colour; found 8x6"):
        load_sequence(folder)


# --- which images belong together ------------------------------------------------------------------------------------


def test_lists_that_name_depth_first_are_understood(folder: Path) -> None:
    """ICL-NUIM's, and TUM's script called with the lists the other way round; the frame's stamp is the colour's."""
    rows = [line.split() for line in lines(folder / "associations.txt")]
    swapped = [f"{float(row[2]) + 0.01:.6f} {row[3]} {row[0]} {row[1]}" for row in rows]
    (folder / "associations.txt").write_text("\n".join(swapped))
    assert frames_read(folder) == (list(range(FRAMES)), ())
    np.testing.assert_allclose(load_sequence(folder).times, STEP * np.arange(FRAMES))


def test_colour_without_depth_is_left_out(folder: Path) -> None:
    (folder / "associations.txt").unlink()
    rows = lines(folder / "depth.txt")
    late = rows[4].replace("0.400000 ", "0.430000 ", 1)  # 30 ms off
    (folder / "depth.txt").write_text("\n".join([*rows[:4], late, *rows[5:]]))
    numbers, notices = frames_read(folder)
    assert numbers == [0, 1, 2, 3, 5, 6, 7]
    assert_notice(notices, "rgb.txt: 1 of 8 images have no depth image within 20 ms")


milliseconds = st.lists(st.integers(0, 300) | st.integers(0, 30), max_size=30, unique=True)
stamps = milliseconds.map(lambda ms: 1e-3 * np.sort(np.array(ms, float)))


@given(stamps, stamps)
def test_association_is_tums(first: np.ndarray, second: np.ndarray) -> None:
    """TUM's own algorithm is written out here: all pairs within tolerance, nearest first, each stamp once."""
    near = sorted((abs(a - b), a, b) for a in first for b in second if abs(a - b) < 0.02 + 1e-9)
    left_a, left_b, expected = set(first), set(second), []
    for _, a, b in near:
        if a in left_a and b in left_b:
            left_a.remove(a)
            left_b.remove(b)
            expected.append((a, b))
    found = [(first[i], second[j]) for i, j in associate_one_to_one(first, second, 0.02)]
    assert len(found) == len(expected)
    assert sum(abs(a - b) for a, b in found) == pytest.approx(sum(abs(a - b) for a, b in expected))
    assert len({a for a, _ in found}) == len({b for _, b in found}) == len(found)


def test_dense_stamps_are_paired_without_all_pairs() -> None:
    """Each of 100,000 stamps, all within tolerance of each other, is paired with its nearest."""
    first = np.arange(100_000) * 1e-7
    pairs = associate_one_to_one(first, first + 2e-8, 0.02)
    assert pairs == [(i, i) for i in range(len(first))]


def test_the_real_lists_give_the_published_pairs(shared_data: Path, tmp_path: Path) -> None:
    """TUM's fr1_xyz with and without its ``associations.txt``."""
    real = shared_data / "tum_fr1_xyz"
    for path in real.iterdir():
        if path.name != "associations.txt":
            (tmp_path / path.name).symlink_to(path)
    listed, found = load_sequence(real), load_sequence(tmp_path)
    pairs = [[(frame.time, frame.rgb.name, frame.depth.name) for frame in s.frames] for s in (listed, found)]
    assert pairs[0] == pairs[1]
    assert listed.notices == found.notices == ()
