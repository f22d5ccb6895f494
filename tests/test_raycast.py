"""The raycast camera against hand-computed rooms, an independent ray-box oracle and MuJoCo's rays."""

import math
import pickle
import sys

import numpy as np
import pytest
from box_rooms import furniture, two_rooms
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.camera import Camera
from vssm_gym.envs import raycast, shading
from vssm_gym.envs.mjcf import World
from vssm_gym.envs.raycast import EmbreeTracer, MujocoTracer, RaycastCamera
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scene import Material, SolidBox
from vssm_gym.envs.sensors import CameraConfig, make_camera
from vssm_gym.errors import InputError
from vssm_gym.geometry import planar_to_matrix

ROBOT = HolonomicRobot()
CAMERA = Camera.from_hfov(64, 48, math.pi / 2)
PLAIN = Material(color=(0.5, 0.6, 0.7))
SHELL = two_rooms().boxes()


def solid(center, size, yaw=0.0, material=PLAIN, kind="furniture") -> SolidBox:
    return SolidBox("box", kind, tuple(center), tuple(size), yaw, material)


def room(width: float, depth: float, height: float, t: float = 0.2) -> list[SolidBox]:
    """A closed room [0, width] x [0, depth] x [0, height]."""
    w, d, h = width, depth, height
    return [
        solid((w / 2, d / 2, -t / 2), (w, d, t), kind="floor"),
        solid((w / 2, d / 2, h + t / 2), (w, d, t), kind="ceiling"),
        solid((-t / 2, d / 2, h / 2), (t, d, h), kind="wall"),
        solid((w + t / 2, d / 2, h / 2), (t, d, h), kind="wall"),
        solid((w / 2, -t / 2, h / 2), (w, t, h), kind="wall"),
        solid((w / 2, d + t / 2, h / 2), (w, t, h), kind="wall"),
    ]


def look(x: float, y: float, heading: float) -> np.ndarray:
    return planar_to_matrix(np.array([x, y, heading])) @ ROBOT.T_body_cam


def hits(box: SolidBox, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Slab intersection of rays with one box, float64: the oracle. Infinite where it is missed."""
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    R_box_world = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    o, d = R_box_world @ (origin - box.center), directions @ R_box_world.T
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (-np.sign(d) * np.array(box.size) / 2 - o) / d, (np.sign(d) * np.array(box.size) / 2 - o) / d
    enter, leave = near.max(axis=1), far.min(axis=1)
    t = np.where(enter > 0.0, enter, leave)  # from inside, the far side is seen
    return np.where((enter <= leave) & (leave > 0.0), t, np.inf)


def test_a_box_room_has_the_depths_one_computes_by_hand():
    camera = Camera.from_hfov(41, 31, math.pi / 2)
    _, depth = RaycastCamera(room(5.0, 4.0, 2.5), camera).render(look(1.0, 2.0, 0.0))
    wall = 4.0  # m ahead; the z-depth of a wall that faces the camera is the same in every pixel that shows it
    fy, cy, height = camera.K[1, 1], camera.K[1, 2], ROBOT.camera_height
    fx, cx = camera.K[0, 0], camera.K[0, 2]
    v, u = np.mgrid[0:31, 0:41]
    with np.errstate(divide="ignore"):
        floor = np.where(v > cy, height * fy / (v - cy), np.inf)
        ceiling = np.where(v < cy, (2.5 - height) * fy / (cy - v), np.inf)
        side = 2.0 * fx / np.abs(u - cx)
    expected = np.minimum.reduce([np.full(v.shape, wall), floor, ceiling, side])
    assert depth[15, 20] == wall
    np.testing.assert_allclose(depth, expected, rtol=1e-6)


layouts = st.lists(
    st.tuples(
        st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 2)),
        st.tuples(st.floats(0.02, 1.5), st.floats(0.02, 1.5), st.floats(0.02, 1.5)),
        st.floats(-math.pi, math.pi),
    ),
    min_size=1,
    max_size=8,
)


@given(layouts, st.floats(-math.pi, math.pi))
def test_depth_and_box_agree_with_slab_intersection(layout, heading):
    boxes = [solid(*box) for box in layout]
    T_world_cam = look(0.0, 0.0, heading)
    rays = np.asarray(CAMERA.rays(), dtype=np.float64).reshape(-1, 3) @ T_world_cam[:3, :3].T
    all_hits = np.stack([hits(box, T_world_cam[:3, 3], rays) for box in boxes])
    expected = all_hits.min(axis=0)
    for tracer in (EmbreeTracer(boxes), single_rays(boxes)):
        t, box = tracer.trace(T_world_cam[:3, 3], rays.astype(np.float32))
        assert ((box == -1) == (t == 0.0)).all()
        t = np.where(box == -1, np.inf, t)
        own = np.where(box == -1, np.inf, all_hits[box, np.arange(len(box))])  # boxes may coincide: any will do
        right = np.isclose(t, expected, rtol=1e-4, atol=1e-4) & np.isclose(own, expected, rtol=1e-4, atol=1e-4)
        assert np.mean(~right) < 0.01  # a ray through an edge may go either way in float32: few do


def single_rays(boxes: list[SolidBox]) -> EmbreeTracer:
    tracer = EmbreeTracer(boxes)
    tracer._packets = None
    return tracer


@pytest.mark.skipif(sys.platform != "linux", reason="the wheel for Linux is the one looked into")
def test_packets_are_in_reach_and_equal_single_rays():
    tracer = EmbreeTracer(SHELL)
    assert tracer.packets
    origin, directions = np.array([1.5, 2.0, 0.4]), np.random.default_rng(0).normal(size=(999, 3)).astype(np.float32)
    (t, box), (t_single, box_single) = tracer.trace(origin, directions), single_rays(SHELL).trace(origin, directions)
    np.testing.assert_allclose(t, t_single, atol=1e-5)
    assert np.mean(box == box_single) > 0.99


@given(st.floats(0.3, 2.7), st.floats(0.3, 3.7), st.floats(-math.pi, math.pi))
def test_embree_and_mujoco_agree(x, y, heading):
    apartment = two_rooms(pieces=(furniture("table", (2.0, 1.0, 0.3), (0.6, 0.4, 0.6), 0.5),))
    T_world_cam = look(x, y, heading)
    images = [
        RaycastCamera(apartment.boxes(), CAMERA, tracer).render(T_world_cam)
        for tracer in (None, MujocoTracer(World(apartment, ROBOT)))
    ]
    (rgb, depth), (rgb_mujoco, depth_mujoco) = images
    close = np.abs(depth - depth_mujoco) <= 1e-4
    assert np.mean(close) > 0.998  # the rest: rays through an edge
    assert np.mean(np.abs(rgb[close].astype(int) - rgb_mujoco[close]) > 1) < 0.01


def test_threads_do_not_change_a_byte():
    one, three = (RaycastCamera(SHELL, Camera.from_hfov(50, 37, 1.2), threads=n) for n in (1, 3))
    for heading in np.linspace(-3, 3, 7):
        for a, b in zip(one.render(look(1.5, 2.0, heading)), three.render(look(1.5, 2.0, heading)), strict=True):
            assert a.tobytes() == b.tobytes()
    three.close()
    np.testing.assert_array_equal(three.render(look(1.5, 2.0, 3.0))[0], one.render(look(1.5, 2.0, 3.0))[0])


def test_where_nothing_is_hit_depth_is_zero_and_the_sky_shows():
    rgb, depth = RaycastCamera([solid((3.0, 0.0, 0.0), (0.2, 0.2, 0.2))], CAMERA).render(look(0.0, 0.0, 0.0))
    assert 0.0 < np.mean(depth > 0.0) < 0.1
    assert (rgb[depth == 0.0] == np.round(255 * np.array(shading.SKY))).all()
    assert depth.dtype == np.float32 and rgb.dtype == np.uint8


def quarters(names):
    """A picture with red upper left, green upper right, blue lower left, white lower right."""
    image = np.zeros((128, 128, 3), np.uint8)
    image[:64, :64, 0], image[:64, 64:, 1], image[64:, :64, 2] = 255, 255, 255
    image[64:, 64:] = 255
    return np.stack([image] * len(names))


@pytest.mark.parametrize("heading", [0.0, math.pi / 2, math.pi, -math.pi / 2, 0.7])
def test_a_painting_hangs_upright_and_unmirrored_on_every_face(monkeypatch, heading):
    monkeypatch.setattr(shading, "texture_atlas", quarters)
    ahead = np.array([math.cos(heading), math.sin(heading)])
    painting = solid((*(2.0 * ahead), 0.4), (1.0, 1.0, 1.0), yaw=heading, material=Material(color=(1, 1, 1), scale=1.0))
    rgb, _ = RaycastCamera([painting], CAMERA).render(look(0.0, 0.0, heading))
    rows, columns = (slice(20, 23), slice(25, 28)), (slice(26, 30), slice(34, 38))
    dominant = [[rgb[r, c].reshape(-1, 3).mean(axis=0) for c in columns] for r in rows]
    assert np.argmax(dominant[0][0]) == 0 and np.argmax(dominant[0][1]) == 1 and np.argmax(dominant[1][0]) == 2
    assert dominant[1][1].min() > 100


def test_a_wall_in_two_pieces_looks_like_one():
    material = Material(color=(0.9, 0.8, 0.7), texture="brick", scale=0.7)
    whole = [solid((2.0, 0.3, 1.0), (0.1, 4.0, 2.0), material=material, kind="wall")]
    parts = [
        solid((2.0, -0.95, 1.0), (0.1, 1.5, 2.0), material=material, kind="wall"),
        solid((2.0, 1.05, 1.0), (0.1, 2.5, 2.0), material=material, kind="wall"),
    ]
    for heading in (0.0, 0.3):
        for x in (0.0, 4.0):  # both sides of the wall
            T_world_cam = look(x, 0.0, heading if x == 0.0 else math.pi - heading)
            a, b = (RaycastCamera(boxes, CAMERA).render(T_world_cam)[0].astype(int) for boxes in (whole, parts))
            assert np.abs(a - b).max() <= 1


def test_far_away_a_texture_shows_its_mean():
    """Where a pixel covers many tiles, sampling must average them: a tracker would take shimmer for motion."""
    fine = Material(color=(1, 1, 1), texture="brick", scale=0.02)
    plain_value = shading.texture_atlas(["brick"])[0].reshape(-1, 3).mean(axis=0)
    rgb, _ = RaycastCamera([solid((4.0, 0.0, 0.0), (0.2, 20.0, 20.0), material=fine)], CAMERA).render(look(0, 0, 0))
    spread = rgb.astype(float).std(axis=(0, 1)) / rgb.mean(axis=(0, 1))
    assert (spread < 0.05).all()  # what is left is the head lamp's falloff
    ratio = rgb[24, 32] / plain_value
    assert ratio.std() / ratio.mean() < 0.02


@given(st.floats(0.1, 0.5))
def test_colour_scales_the_image(share):
    full, part = (
        RaycastCamera([solid((2.0, 0.0, 0.0), (0.2, 9.0, 9.0), material=Material(color=color, texture="wood"))], CAMERA)
        .render(look(0.0, 0.0, 0.0))[0]
        .astype(float)
        for color in ((0.9, 0.9, 0.9), (0.9 * share,) * 3)
    )
    assert np.abs(full * share - part).max() <= 1.0


def test_a_pickled_camera_renders_the_same():
    camera = RaycastCamera(SHELL, CAMERA, threads=2)
    rgb, depth = camera.render(look(1.0, 1.0, 0.4))
    again = pickle.loads(pickle.dumps(camera)).render(look(1.0, 1.0, 0.4))
    assert rgb.tobytes() == again[0].tobytes() and depth.tobytes() == again[1].tobytes()


def test_without_embree_the_fallback_says_so(monkeypatch):
    world = World(two_rooms(), ROBOT)
    assert make_camera(world, CameraConfig(64, 48)).name == "raycast-embree"
    monkeypatch.setitem(sys.modules, "embreex", None)  # makes the import fail as it does without a wheel
    with pytest.warns(RuntimeWarning, match="embreex cannot be imported"):
        camera = make_camera(world, CameraConfig(64, 48), threads=2)
    assert isinstance(camera, RaycastCamera)
    assert camera.name == "raycast-mujoco" and camera.threads == 1
    assert camera.render(look(1.0, 1.0, 0.4))[1].min() > 0.0


def test_without_packets_single_rays_serve_and_say_so(monkeypatch):
    def missing(package):
        raise OSError("no libembree4")

    monkeypatch.setattr(raycast, "find_library", missing)
    with pytest.warns(RuntimeWarning, match="no libembree4"):
        tracer = EmbreeTracer(SHELL)
    assert not tracer.packets and tracer.name == "raycast-embree"


@pytest.mark.parametrize(("field", "value"), [("width", 0), ("height", 12.5), ("hfov", 4.0), ("hfov", math.nan)])
def test_a_bad_camera_is_named(field, value):
    with pytest.raises(InputError, match=field):
        CameraConfig(**{field: value})
