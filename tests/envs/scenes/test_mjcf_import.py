"""Test MJCF scenes: upright boxes are exact, other shapes within a cell, floors are found, harmful files refused."""

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.helpers.damage import damaged_bytes, valid_or_refused
from tests.helpers.scene_checks import check_scene
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.importers.mjcf import import_mjcf
from vssm_gym.envs.scenes.importers.mjcf_xml import StillModel
from vssm_gym.envs.scenes.importers.voxels import VOXEL_EDGE, bounds_of, inside_of, voxelised
from vssm_gym.envs.scenes.scene import Apartment, Box, load_scene
from vssm_gym.errors import InputError

WALLS = "".join(
    f'<geom type="box" name="w{i}" size="{sx} {sy} 1.25" pos="{x} {y} 1.25" rgba=".9 .8 .7 1"/>'
    for i, (sx, sy, x, y) in enumerate([(3.1, 0.1, 0, 2.6), (3.1, 0.1, 0, -2.6), (0.1, 2.7, 3, 0), (0.1, 2.7, -3, 0)])
)


PLANE = '<geom type="plane" name="floor" size="5 5 .1"/>'


def written(folder: Path, body: str, head: str = "", floor: str = PLANE) -> Path:
    path = folder / "scene.xml"
    path.write_text(f"<mujoco>{head}<worldbody>{floor}{body}</worldbody></mujoco>")
    return path


def boxes_of(flat: Apartment, name: str) -> list[Box]:
    (piece,) = [piece for piece in flat.furniture if piece.name == name]
    return list(piece.boxes)


def test_a_room_by_hand(tmp_path: Path) -> None:
    crate = '<body name="crate" pos="1 1 .3" euler="0 0 30"><freejoint/><geom type="box" size=".2 .3 .25"/></body>'
    lying = '<geom name="lying" type="box" size=".4 .3 .2" pos="-1 1 .4" euler="90 0 0"/>'
    lights = '<light pos="0 0 3"/><camera name="c" pos="0 0 1"/><site name="s"/>'
    floor = '<geom type="plane" name="floor" size="20 20 .1" pos="0 0 -.1" material="g"/>'
    head = '<asset><texture name="t" type="2d" builtin="checker" width="9" height="9"/>' \
        '<material name="g" texture="t" rgba=".2 .4 .6 1"/></asset><option timestep=".1"/>'  # fmt: skip
    flat = load_scene(written(tmp_path, WALLS + crate + lying + lights, head, floor))
    (room,) = flat.rooms
    assert shapely.Polygon(room.polygon).bounds == pytest.approx((-2.95, -2.55, 2.95, 2.55))  # 5 cm inside the walls
    assert room.floor.color == pytest.approx((0.52, 0.64, 0.76))
    (box,) = boxes_of(flat, "crate")
    assert box.center == pytest.approx((1, 1, 0.4)) and box.size == pytest.approx((0.4, 0.6, 0.5))
    assert box.yaw == pytest.approx(math.radians(30))
    (box,) = boxes_of(flat, "lying")  # a quarter turn about x: its y is up
    assert box.center == pytest.approx((-1, 1, 0.5)) and sorted(box.size) == pytest.approx([0.4, 0.6, 0.8])
    assert box.size[2] == pytest.approx(0.6)
    assert flat.notes[0] == "1 joint frozen: bodies stay at their initial pose"
    assert "moved by 0.100 m: the floor is z = 0" in flat.notes
    space = check_scene(flat)
    assert space.region.bounds == pytest.approx((-2.8, -2.4, 2.8, 2.4), abs=2e-3)


def test_an_open_floor_gets_walls(tmp_path: Path) -> None:
    """An endless plane ends a metre beyond what stands on it; a flat box is a floor too."""
    post = '<geom name="post" type="box" size=".5 .5 .5" pos="2 0 .5"/>'
    endless = load_scene(written(tmp_path, post, floor='<geom type="plane" size="0 0 .1"/>'))
    assert shapely.Polygon(endless.rooms[0].polygon).bounds == pytest.approx((0.5, -1.5, 3.5, 1.5))
    slab = load_scene(written(tmp_path, post, floor='<geom type="box" size="4 3 .1" pos="0 0 -.3" euler="0 0 10"/>'))
    assert shapely.Polygon(slab.rooms[0].polygon).area == pytest.approx(48.0)
    assert boxes_of(slab, "post")[0].center[2] == pytest.approx(0.7)
    check_scene(slab)


@pytest.mark.parametrize("shape", ["box", "sphere", "ellipsoid", "cylinder", "capsule"])
@given(size=st.lists(st.floats(0.05, 0.5), min_size=3, max_size=3))
@settings(max_examples=15, deadline=None)
def test_voxels_fill_the_shape(shape: str, size: list[float]) -> None:
    """Points two cells deep are in a box, points two cells outside are not, and the volume is right."""
    half = np.array(size)
    bounds = np.abs(bounds_of(shape, half)).max(axis=0)
    boxes = voxelised(-bounds, bounds, inside_of(shape, half))
    points = np.random.default_rng(0).uniform(-bounds - 0.1, bounds + 0.1, (2000, 3))
    low, high = (np.array(corner) for corner in zip(*boxes, strict=True))
    filled = ((points[:, None] >= low) & (points[:, None] <= high)).all(axis=-1).any(axis=1)
    assert inside_of(shape, half + 2 * VOXEL_EDGE)(points)[filled].all()
    if half.min() > 3 * VOXEL_EDGE:
        assert filled[inside_of(shape, half - 2 * VOXEL_EDGE)(points)].all()
    volume = np.prod(high - low, axis=1).sum()
    exact = {
        "box": 8 * half.prod(),
        "sphere": 4 / 3 * math.pi * half[0] ** 3,
        "ellipsoid": 4 / 3 * math.pi * half.prod(),
        "cylinder": 2 * math.pi * half[0] ** 2 * half[1],
        "capsule": math.pi * half[0] ** 2 * (2 * half[1] + 4 / 3 * half[0]),
    }[shape]
    assert volume == pytest.approx(exact, rel=0.4 if half.min() < 0.15 else 0.12)


@given(st.floats(-180, 180), st.floats(-180, 180), st.floats(-180, 180))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_turned_box_keeps_its_place_and_volume(tmp_path: Path, a: float, b: float, c: float) -> None:
    turned = f'<geom name="t" type="box" size=".4 .3 .2" pos="1 0 1" euler="{a} {b} {c}"/>'
    boxes = boxes_of(load_scene(written(tmp_path, turned)), "t")
    volumes = np.array([np.prod(box.size) for box in boxes])
    assert volumes.sum() == pytest.approx(0.192, rel=0.1)
    center = np.array([box.center for box in boxes]).T @ volumes / volumes.sum()
    np.testing.assert_allclose(center, (1, 0, 1), atol=0.01)


def test_meshes_become_shells(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    corners = [(x, y, z) for x in (0, 1) for y in (0, 0.5) for z in (0, 0.8)]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    text += "".join(f"f {a} {b} {c}\nf {a} {c} {d}\n" for a, b, c, d in quads)
    (tmp_path / "meshes" / "block.obj").write_text(text)
    head = '<compiler meshdir="meshes"/><asset><mesh file="block.obj"/></asset>'
    flat = load_scene(written(tmp_path, '<geom name="m" type="mesh" mesh="block" pos="1 1 0"/>', head))
    boxes = boxes_of(flat, "m")
    low = np.min([np.subtract(box.center, np.array(box.size) / 2) for box in boxes], axis=0)
    high = np.max([np.add(box.center, np.array(box.size) / 2) for box in boxes], axis=0)
    np.testing.assert_allclose(low, (1, 1, 0), atol=1e-5)
    np.testing.assert_allclose(high, (2, 1.5, 0.8), atol=1e-5)
    space = FreeSpace.from_apartment(flat, 0.1, 0.5)
    assert not space.contains(np.array([0.95, 1.25])) and space.contains(np.array([0.85, 1.25]))


BOMB = '<!DOCTYPE m [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("body", "head", "floor", "expected"),
    [
        ("", "", "", "a floor"),
        ('<geom type="box" size="1 1 1"/>', "", "", "a floor"),
        ("", "", '<geom type="plane" size="3 3 .1" euler="20 0 0"/>', "a floor"),
        ("", "", '<geom type="plane" size="0 0 .1"/>', "geoms on the floor"),
        ("<geom type='box' size='nan 1 1'/>", "", None, "MuJoCo compiles"),
        ("<geom type='box' size='1 1 1' pos='1e9 0 0'/>", "", None, "numbers within"),
        ("<geom type='box' size='1 1'/>", "", None, "MuJoCo compiles"),
        ("<geom type='teapot' size='1'/>", "", None, "MuJoCo compiles"),
        ("<geom type='plane' size='0 0 1' euler='90 0 0'/>", "", None, "only the floor"),
        ("<replicate count='100000000'><geom size='1'/></replicate>", "", None, "up to 5,000"),
        ("<replicate count='999'><replicate count='9'><geom size='1'/></replicate></replicate>", "", None, "up to 5,0"),
        ("<replicate count='999'><replicate count='9999'></replicate></replicate>", "", None, "up to 5,000"),
        ("<replicate count='²'><geom size='1'/></replicate>", "", None, "a whole number"),
        ("<geom name='moon' size='1000'/>", "", None, "less than or equal to 1000"),
        ("<body>" * 200 + "</body>" * 200, "", None, "64 levels"),
        ("<geom type='mesh' mesh='m'/>", '<asset><mesh name="m" file="../m.obj"/></asset>', None, "inside the model's"),
        ("<geom type='mesh' mesh='m'/>", '<asset><mesh name="m" file="/etc/passwd"/></asset>', None, "inside the"),
        ("<geom type='mesh' mesh='m'/>", '<asset><mesh name="m" file="gone.obj"/></asset>', None, "existing file"),
        ("<geom type='mesh' mesh='m'/>", '<asset><mesh name="m" builtin="sphere"/></asset>', None, "a mesh of a file"),
        ("", '<include file="../other.xml"/>', None, "inside the model's folder"),
        ("", '<include file="scene.xml"/>', None, "includes"),
        ("<geom size='1'/></worldbody><worldbody>", "<compiler angle='up'/>", None, "MuJoCo compiles"),
        ("<oops", "", None, "XML"),
    ],
)  # fmt: skip
def test_bad_models_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, head: str, floor: str | None, expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, body, head, '<geom type="plane" size="5 5 .1"/>' if floor is None else floor)
    with pytest.raises(InputError) as caught:
        load_scene(path)
    assert expected in caught.value.expected
    assert caught.value.source == str(path)
    assert [file.name for file in tmp_path.iterdir()] == ["scene.xml"]  # no log of MuJoCo's


def test_what_holds_no_geom_is_left_to_nobody(tmp_path: Path) -> None:
    """MuJoCo needs minutes for 50,000 empty bodies."""
    empty = "<body><frame/></body>" * 20_000
    model = tmp_path / "empty.xml"
    model.write_text(f"<mujoco><worldbody><geom type='plane' size='5 5 .1'/>{empty}</worldbody></mujoco>")
    assert StillModel(model).xml.count("<body") == 0


def test_document_types_and_other_roots_are_refused(tmp_path: Path) -> None:
    for text, expected in ((BOMB + "<mujoco>&b;</mujoco>", "document type"), ("<robot/>", "root element mujoco")):
        (tmp_path / "scene.xml").write_text(text)
        with pytest.raises(InputError, match=expected):
            load_scene(tmp_path / "scene.xml")
        (tmp_path / "scene.xml").write_bytes(text.encode("utf-16"))
        with pytest.raises(InputError, match=expected):
            load_scene(tmp_path / "scene.xml")


def test_omitted_elements_are_reported(tmp_path: Path) -> None:
    body = '<composite type="cable" count="3 1 1"/><geom size=".1" pos="0 0 1"/>'
    assert "left out: composite (1)" in load_scene(written(tmp_path, body)).notes


def test_includes_are_read(tmp_path: Path) -> None:
    (tmp_path / "walls.xml").write_text(f"<mujocoinclude>{WALLS}</mujocoinclude>")
    flat = load_scene(written(tmp_path, '<include file="walls.xml"/>'))
    assert [piece.name for piece in flat.furniture] == ["w0", "w1", "w2", "w3"]


SMALL = """<mujoco><compiler angle="degree"/><default><geom rgba=".5 .4 .3 1"/></default><worldbody>
<geom type="plane" size="3 3 .1"/>
<body pos="1 1 1"><joint/><geom type="capsule" fromto="0 0 0 .5 .5 .5" size=".1"/></body>
<replicate count="3" offset="0 .5 0"><geom type="box" size=".1 .2 .3" euler="10 20 30"/></replicate>
</worldbody></mujoco>"""


@given(damaged_bytes(SMALL.encode()))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_models(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "scene.xml").write_bytes(content)
    valid_or_refused(lambda: import_mjcf(tmp_path / "scene.xml"))


NUMBERS = ["", "0", "-1", "nan", "1e9", "1e-30", "9" * 400, "1 2", "0 0 0", "5 5 5"]
NASTY = [*NUMBERS, "mesh", "hfield", "plane", "sphere", "x"]


@given(st.data())
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_attributes(tmp_path: Path, data: st.DataObject) -> None:
    root = ET.fromstring(SMALL)
    for _ in range(data.draw(st.integers(1, 3))):
        element = data.draw(st.sampled_from(list(root.iter())))
        keys = [*element.attrib, "size", "pos", "euler", "type", "mesh", "rgba", "name", "childclass", "fromto"]
        element.set(data.draw(st.sampled_from(keys)), data.draw(st.sampled_from(NASTY)))
    (tmp_path / "scene.xml").write_text(ET.tostring(root, encoding="unicode"))
    valid_or_refused(lambda: import_mjcf(tmp_path / "scene.xml"))
