"""Test ROS maps: every free cell is floor, every other cell beside it is wall, for all origins and formats."""

import math
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy import ndimage

from tests.helpers.damage import damaged_bytes, damaged_json, valid_or_refused
from tests.helpers.paths import SHARED_DATA
from tests.helpers.scene_checks import check_scene
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.importers.rectangles import cover
from vssm_gym.envs.scenes.importers.ros_map import LEAST_PIECE, import_ros_map
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.errors import InputError

DATA = SHARED_DATA / "maps2d" / "willow-2010-02-18-0.10.yaml"
FREE, OCCUPIED, UNKNOWN = 254, 0, 205
fixture_is_fine = settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])

SETTINGS: dict[str, Any] = {
    "image": "map.pgm",
    "resolution": 0.1,
    "origin": [-2.0, 1.0, 0.0],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def grey_room() -> np.ndarray:
    """Return rows from the top: 6 x 4 m of free cells with a 1 m pillar, a wall of one cell, unknown beyond."""
    grey = np.full((50, 70), UNKNOWN, np.uint8)
    grey[4:46, 4:66] = OCCUPIED
    grey[5:45, 5:65] = FREE
    grey[10:20, 12:22] = OCCUPIED
    return grey


def pgm(grey: np.ndarray, binary: bool = True) -> bytes:
    most = 65535 if grey.dtype == np.uint16 else 255
    head = f"{'P5' if binary else 'P2'}\n# a comment\n{grey.shape[1]} {grey.shape[0]}\n{most}\n".encode()
    return head + (grey.astype(">u2" if most > 255 else "u1").tobytes() if binary else
                   " ".join(map(str, grey.ravel())).encode())  # fmt: skip


def written(folder: Path, grey: np.ndarray, binary: bool = True, **changes: Any) -> Path:
    (folder / "map.pgm").write_bytes(pgm(grey, binary))
    (folder / "map.yaml").write_text(yaml.safe_dump(SETTINGS | changes))
    return folder / "map.yaml"


def test_a_room_by_hand(tmp_path: Path) -> None:
    flat = load_scene(written(tmp_path, grey_room()))
    (room,) = flat.rooms
    x0, y0, x1, y1 = shapely.Polygon(room.polygon).bounds
    # Columns 5 to 65 of 0.1 m from x = -2; rows 5 to 45 from the top are 5 to 45 from the bottom, from y = 1.
    assert (x0, y0, x1, y1) == pytest.approx((-1.56, 1.44, 4.56, 5.56))
    space = FreeSpace.from_apartment(flat, 0.1, 0.5)
    assert space.region.bounds == pytest.approx((-1.4, 1.6, 4.4, 5.4), abs=2e-3)
    assert not space.contains(np.array([-2 + 0.1 * 17, 1 + 0.1 * (50 - 15)]))  # the pillar, rows 10 to 20 from the top
    assert len(flat.walls) < 8
    assert any("unknown" in note for note in flat.notes) is False
    check_scene(flat)


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.floats(0.03, 0.3), st.floats(-math.pi, math.pi), st.booleans())
@fixture_is_fine
def test_free_cells_are_free_and_the_others_beside_them_are_wall(
    tmp_path: Path, seed: int, resolution: float, yaw: float, binary: bool
) -> None:
    rng = np.random.default_rng(seed)
    blobs = ndimage.gaussian_filter(rng.standard_normal((40, 55)), 2.0)
    grey = np.where(blobs > 0.03, FREE, np.where(blobs > -0.1, OCCUPIED, UNKNOWN)).astype(np.uint8)
    path = written(tmp_path, grey, binary, resolution=resolution, origin=[3.0, -4.0, yaw])
    flat = valid_or_refused(lambda: import_ros_map(path))
    labels, _ = ndimage.label(grey == FREE)
    large = [i for i, n in enumerate(np.bincount(labels.ravel())) if i and n * resolution**2 >= LEAST_PIECE]
    assert (flat is None) == (not large)
    if flat is None:
        return
    floor = np.isin(labels, large)
    rows, columns = np.indices(grey.shape)
    local = np.stack([columns + 0.5, grey.shape[0] - rows - 0.5], axis=-1) * resolution
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    centers = local @ turn + (3.0, -4.0)
    solid = shapely.union_all([footprint(box) for box in flat.boxes() if box.kind == "wall"])
    rooms = shapely.union_all([shapely.Polygon(room.polygon) for room in flat.rooms])
    beside = ndimage.binary_dilation(floor, np.ones((3, 3), bool)) & ~floor
    solid, rooms = solid.buffer(1e-6), rooms.buffer(1e-6)
    shapely.prepare((solid, rooms))
    x, y = centers[..., 0], centers[..., 1]
    assert not shapely.contains_xy(solid, x, y)[floor].any()
    assert shapely.contains_xy(solid, x, y)[beside].all()
    assert shapely.contains_xy(rooms, x, y)[floor].all()
    # Nor does a wall cover the edge of a cell of the floor.
    reach = 0.49 * resolution * np.array([math.cos(yaw), math.sin(yaw)])
    for dx, dy in (reach, -reach, (-reach[1], reach[0]), (reach[1], -reach[0])):
        assert not shapely.contains_xy(solid, x + dx, y + dy)[floor].any()


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("image", ["P2", "P5", "P5 of 16 bits", "PNG", "PNG of 16 bits", "PNG in colour", "negated"])
def test_formats_and_modes_give_one_scene(tmp_path: Path, mode: str, image: str) -> None:
    grey = grey_room()
    grey[grey == UNKNOWN] = OCCUPIED
    changes: dict[str, Any] = {"mode": mode}
    if mode == "raw":
        grey = np.where(grey == FREE, 0, 100).astype(np.uint8)
    elif image == "negated":
        grey, changes["negate"] = 255 - grey, 1
    path = written(tmp_path, grey, binary=image != "P2", **changes)
    if image == "P5 of 16 bits":
        (tmp_path / "map.pgm").write_bytes(pgm(grey.astype(np.uint16) * 257))
    elif image.startswith("PNG"):
        picture = Image.fromarray(grey.astype(np.uint16) * 257 if "16" in image else grey)
        (picture.convert("RGBA") if "colour" in image else picture).save(tmp_path / "map.png")
        path = written(tmp_path, grey, **changes, image="map.png")
    reference = tmp_path / "reference"
    reference.mkdir()
    expected = import_ros_map(written(reference, np.where(grey_room() == FREE, FREE, OCCUPIED).astype(np.uint8)))
    assert import_ros_map(path).content_hash() == expected.content_hash()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_rectangles_cover_all_needed_cells_and_only_allowed_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    allowed = ndimage.gaussian_filter(rng.standard_normal(rng.integers(1, 30, 2)), 1.0) > 0.0
    needed = allowed & (rng.uniform(size=allowed.shape) < 0.5)
    count = np.zeros(allowed.shape, int)
    for i0, i1, j0, j1 in cover(needed, allowed):
        assert i1 > i0 and j1 > j0
        count[i0:i1, j0:j1] += 1
    assert (count[needed] == 1).all() and (count[~allowed] == 0).all() and count.max(initial=0) <= 1
    found = cover(needed, allowed)
    assert cover(needed, allowed, len(found)) == found
    if found:
        assert cover(needed, allowed, len(found) - 1) == found  # one more than asked for says: too many
        assert cover(needed, allowed, 0) == found[:1]


@pytest.mark.parametrize(
    ("changes", "field", "expected"),
    [
        ({"image": "../map.pgm"}, "image", "inside its folder"),
        ({"image": "/etc/passwd"}, "image", "inside its folder"),
        ({"image": "other.pgm"}, "image", "existing file"),
        ({"image": "map.yaml"}, "image", "a PGM (P2, P5) or PNG image"),
        ({"resolution": 0}, "resolution", "greater than or equal"),
        ({"resolution": "nan"}, "resolution", "finite"),
        ({"resolution": 100}, "resolution", "less than or equal"),
        ({"origin": [0, 0]}, "origin[2]", "present"),
        ({"origin": [0, 1e9, 0]}, "origin[1]", "less than or equal"),
        ({"mode": "octal"}, "mode", "trinary"),
        ({"negate": "maybe"}, "negate", "boolean"),
        ({"free_thresh": 0.0}, "image", "free cells"),
    ],
)
def test_bad_fields_are_refused(tmp_path: Path, changes: dict[str, Any], field: str, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        load_scene(written(tmp_path, grey_room(), **changes))
    assert caught.value.field == field
    assert expected in caught.value.expected


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "inner").mkdir()
    path = written(tmp_path / "inner", grey_room(), image="link.pgm")
    (tmp_path / "map.pgm").write_bytes(pgm(grey_room()))
    (tmp_path / "inner" / "link.pgm").symlink_to(tmp_path / "map.pgm")
    with pytest.raises(InputError, match="inside its folder"):
        import_ros_map(path)


PNG_HEAD = b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big")


def png_of_size(width: int, height: int) -> bytes:
    header = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 0, 0, 0, 0])
    return PNG_HEAD + header + zlib.crc32(header).to_bytes(4, "big") + bytes(4) + b"IDAT" + bytes(4)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"P5\n100000 100000\n255\n" + bytes(100), "at most 33,554,432"),
        (b"P5\n999999 1\n255\n", "1 to 16384 pixels a side"),
        (b"P5\n300 300\n255\n" + bytes(100), "90,000 bytes"),
        (b"P5\n0 300\n255\n", "1 to 16384"),
        (b"P5\n9999999999999999999 1\n255\n", "header"),
        (b"P5\n10 10\n0\n" + bytes(100), "largest value"),
        (b"P5\n2 2\n3\n" + bytes([9] * 4), "up to the header's 3"),
        (b"P2\n2 2\n255\n1 2 3", "4 whole numbers"),
        (b"P2\n2 2\n255\n1 2 3 -4", "4 whole numbers"),
        (b"P6\n2 2\n255\n" + bytes(12), "PGM (P2, P5) or PNG"),
        (b"", "PGM (P2, P5) or PNG"),
        (b"P5" + b"\n#" * 5000, "header"),
        (png_of_size(60000, 60000), "decompression bomb"),
        (png_of_size(9000, 9000), "at most 33,554,432"),
        (png_of_size(16, 16), "PGM (P2, P5) or PNG"),
    ],
)
def test_images_with_a_false_header_are_refused(tmp_path: Path, content: bytes, expected: str) -> None:
    path = written(tmp_path, grey_room())
    (tmp_path / "map.pgm").write_bytes(content)
    with pytest.raises(InputError) as caught:
        import_ros_map(path)
    assert expected in caught.value.expected


@pytest.mark.parametrize(
    "text",
    [
        "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]",  # what grows to gigabytes
        "[" * 5000,
        "image: !!python/object/apply:os.system [ls]",
        "- image",
        "image: 2001-99-99\nresolution: 0.1",
        "\x00",
        "image: " + "x" * 70_000,
        "",
    ],
)
def test_bad_yaml_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "map.yaml").write_text(text)
    with pytest.raises(InputError):
        import_ros_map(tmp_path / "map.yaml")


@given(st.data())
@settings(fixture_is_fine, max_examples=100)
def test_damaged_maps(tmp_path: Path, data: st.DataObject) -> None:
    path = written(tmp_path, grey_room())
    which = data.draw(st.sampled_from(["fields", "yaml", "image"]))
    if which == "fields":
        path.write_text(yaml.safe_dump(data.draw(damaged_json(SETTINGS)), allow_unicode=True))
    else:
        damaged = path if which == "yaml" else tmp_path / "map.pgm"
        damaged.write_bytes(data.draw(damaged_bytes(damaged.read_bytes())))
    valid_or_refused(lambda: load_scene(path))


def test_many_rooms_take_no_longer_than_one(tmp_path: Path) -> None:
    grey = np.zeros((1024, 1024), np.uint8)
    for i in range(17):
        for j in range(17):
            grey[60 * i + 2 : 60 * i + 58, 60 * j + 2 : 60 * j + 58] = FREE
    began = time.process_time()
    flat = load_scene(written(tmp_path, grey))
    assert time.process_time() - began < 3.0
    assert len(flat.rooms) == 289
    assert all(shapely.Polygon(room.polygon).area == pytest.approx(5.72**2) for room in flat.rooms)


def test_rooms_within_rooms_are_rooms_of_their_own(tmp_path: Path) -> None:
    rows, columns = np.indices((120, 120))
    ring = np.maximum(abs(rows - 60), abs(columns - 60))
    flat = load_scene(written(tmp_path, np.where(ring % 10 < 7, FREE, OCCUPIED).astype(np.uint8)))
    areas = [shapely.Polygon(room.polygon).area for room in flat.rooms]
    assert len(areas) == 7 and areas == sorted(areas)  # the inner ones first, each outline with all that it surrounds
    assert areas[0] == pytest.approx((1.3 + 2 * 0.06) ** 2)


@pytest.mark.parametrize(
    ("resolution", "expected"), [(0.05, "at most 20,000 walls"), (1.0, "a floor of at most 250 m across")]
)
def test_noise_is_refused_quickly(tmp_path: Path, resolution: float, expected: str) -> None:
    grey = np.full((1500, 1500), FREE, np.uint8)
    grey[np.random.default_rng(0).random(grey.shape) < 0.2] = OCCUPIED
    began = time.process_time()
    with pytest.raises(InputError, match=expected):
        load_scene(written(tmp_path, grey, resolution=resolution))
    assert time.process_time() - began < 3.0


@pytest.mark.skipif(not DATA.is_file(), reason="the maps2d files are not on this machine")
def test_the_willow_map() -> None:
    flat = load_scene(DATA)
    assert len(flat.walls) < 6000
    space = FreeSpace.from_apartment(flat, 0.1, 0.5)
    assert space.largest.area > 800.0
    assert space.cut_off_rooms() == []


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_file(), reason="the maps2d files are not on this machine")
def test_a_robot_drives_in_a_wing_of_the_willow_map(tmp_path: Path) -> None:
    with Image.open(DATA.with_suffix(".pgm")) as image:
        wing = np.asarray(image)[360:520, 180:340]
    flat = load_scene(written(tmp_path, wing, **yaml.safe_load(DATA.read_text()) | {"image": "map.pgm"}))
    space = check_scene(flat)
    geodesics = Geodesics(space)
    for start, goal in space.sample(np.random.default_rng(0), 10).reshape(5, 2, 2):
        path = geodesics.path(start, goal)
        if len(path):  # straightened free space has fewer connections, but no false ones
            assert geodesics.length(start, goal) >= np.linalg.norm(start - goal) - 1e-6
            assert space.largest.buffer(1e-3).covers(shapely.LineString(path[1:-1])) if len(path) > 3 else True
