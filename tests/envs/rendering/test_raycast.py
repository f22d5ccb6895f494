"""Test the raycast camera and the tracers against hand-computed rooms, a ray-box oracle and each other."""

import math
import pickle
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.physics import FloorWorld
from vssm_gym.envs.physics.tracing import EmbreeTracer, MujocoTracer
from vssm_gym.envs.rendering import shading
from vssm_gym.envs.rendering.raycast import RaycastCamera
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.scene import Material, SolidBox, load_scene
from vssm_gym.envs.sensors import CameraConfig, make_tracer
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix

ROBOT = HolonomicRobot()
CAMERA = Camera.from_hfov(64, 48, math.pi / 2)
PLAIN = Material(color=(0.5, 0.6, 0.7))
SHELL = two_rooms().boxes()


def solid(center, size, yaw=0.0, material=PLAIN, kind="furniture") -> SolidBox:
    return SolidBox("box", kind, tuple(center), tuple(size), yaw, material)


def room(width: float, depth: float, height: float, t: float = 0.2) -> list[SolidBox]:
    """Return a closed room [0, width] x [0, depth] x [0, height]."""
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
    """Return the distances at which rays hit one box, by slab intersection in float64; infinite for a miss."""
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    R_box_world = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    o, d = R_box_world @ (origin - box.center), directions @ R_box_world.T
    with np.errstate(divide="ignore", invalid="ignore"):
        half = np.copysign(0.5 * np.array(box.size), d)
        near, far = (-half - o) / d, (half - o) / d
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


def seen(boxes: list[SolidBox], T_world_cam: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    depth, box = RaycastCamera(boxes, CAMERA).first_boxes(T_world_cam)
    return depth.ravel(), box.ravel()


def embree(boxes: list[SolidBox], T_world_cam: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return EmbreeTracer(boxes).trace(T_world_cam[:3, 3], rays.astype(np.float32))


def tilted(heading: float, pitch: float, roll: float) -> np.ndarray:
    """Return a pitched and rolled camera above the origin, at the usual height."""
    T = look(0.0, 0.0, heading)
    (cp, sp), (cr, sr) = ((math.cos(a), math.sin(a)) for a in (pitch, roll))
    nod, lean = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]]), np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    T[:3, :3] = T[:3, :3] @ nod @ lean
    return T


angles = st.floats(-math.pi, math.pi)


@pytest.mark.parametrize("first", [seen, embree])
@given(layouts, angles, angles, angles)
def test_depth_and_box_agree_with_slab_intersection(first, layout, heading, pitch, roll):
    """Drawn and traced depths are those of ray and box: from within a box too, and with boxes behind the camera."""
    boxes = [solid(*box) for box in layout]
    T_world_cam = tilted(heading, pitch, roll)
    rays = np.asarray(CAMERA.rays(), dtype=np.float64).reshape(-1, 3) @ T_world_cam[:3, :3].T
    all_hits = np.stack([hits(box, T_world_cam[:3, 3], rays) for box in boxes])
    expected = all_hits.min(axis=0)
    t, box = first(boxes, T_world_cam, rays)
    assert ((box == -1) == (t == 0.0)).all()
    t = np.where(box == -1, np.inf, t)
    own = np.where(box == -1, np.inf, all_hits[box, np.arange(len(box))])  # boxes may coincide: any will do
    right = np.isclose(t, expected, rtol=1e-4, atol=1e-4) & np.isclose(own, expected, rtol=1e-4, atol=1e-4)
    assert np.mean(~right) < 0.01  # a ray through an edge may go either way: few do


@pytest.mark.parametrize("scene", ["oak", "arena", "hall"])
def test_images_equal_embrees(scene):
    """Depths of whole furnished scenes agree pixel by pixel, from random poses."""
    boxes = load_scene(scene).boxes()
    camera, tracer = RaycastCamera(boxes, CAMERA), EmbreeTracer(boxes)
    low, high = (edge([box.center for box in boxes], axis=0) for edge in (np.min, np.max))
    rng = np.random.default_rng(0)
    rays = np.asarray(CAMERA.rays(), dtype=np.float64).reshape(-1, 3)
    wrong = []
    for _ in range(20):
        T_world_cam = look(*rng.uniform(low[:2], high[:2]), rng.uniform(-np.pi, np.pi))
        T_world_cam[2, 3] += 0.0137  # off the plane of any table top
        t, _ = tracer.trace(T_world_cam[:3, 3], (rays @ T_world_cam[:3, :3].T).astype(np.float32))
        depth = camera.render(T_world_cam)[1].ravel()
        wrong.append(np.abs(depth - t) > 1e-4 * (1.0 + t))
    assert np.mean(wrong) < 1e-4  # rays along an edge


@given(layouts, angles, angles, angles)
def test_no_ray_slips_between_faces(layout, heading, pitch, roll):
    """Inside a closed room every pixel hits a surface, for all contents and all tilts of the camera."""
    boxes = [*room(8.0, 8.0, 4.0), *(solid(*box) for box in layout)]
    T_world_cam = tilted(heading, pitch, roll)
    T_world_cam[:3, 3] += 4.0, 4.0, 1.0
    assert RaycastCamera(boxes, CAMERA).render(T_world_cam)[1].min() > 0.0


@pytest.mark.parametrize(("width", "height"), [(161, 121), (64, 1), (33, 3)])
@pytest.mark.parametrize("roll", [0.0, 1e-14, -1e-10])
def test_a_face_seen_edge_on_has_no_false_depths(width, height, roll):
    """A table top exactly at the eye's height, in an image with a row of pixels exactly at the horizon."""
    camera = Camera.from_hfov(width, height, math.pi / 2)
    boxes = [*room(8, 8, 2.5), solid((5.0, 4.0, 0.3), (0.6, 0.6, 0.2), 0.5)]
    T_world_cam = tilted(0.3, 0.0, roll)
    T_world_cam[:3, 3] = 1.5, 4.1, 0.4
    rays = np.asarray(camera.rays(), dtype=np.float64).reshape(-1, 3) @ T_world_cam[:3, :3].T
    expected = np.stack([hits(box, T_world_cam[:3, 3], rays) for box in boxes]).min(axis=0)
    depth = RaycastCamera(boxes, camera).render(T_world_cam)[1].ravel()
    # Along the edge a ray either just meets the table or just passes it.
    table = hits(boxes[-1], T_world_cam[:3, 3] - [0.0, 0.0, 1e-9], rays)
    behind = np.stack([hits(box, T_world_cam[:3, 3], rays) for box in boxes[:-1]]).min(axis=0)
    right = [np.isclose(depth, d, rtol=1e-5) for d in (expected, table, behind)]
    assert np.logical_or.reduce(right).all()


def test_where_faces_coincide_the_first_box_shows():
    """The first box shows everywhere on the common face, independently of rounding."""
    boxes = [solid((3.0, 0.0, 0.4), (1.0, 2.0, 2.0)), solid((3.0, 0.4, 0.4), (1.0, 2.0, 2.0))]
    T_world_cam = tilted(0.37, 0.2, 0.1)
    depth, box = RaycastCamera(boxes, CAMERA).first_boxes(T_world_cam)
    alone = RaycastCamera(boxes[:1], CAMERA).first_boxes(T_world_cam)[0]
    assert (box[alone > 0.0] == 0).all() and (box == 1).any()
    np.testing.assert_array_equal(depth[alone > 0.0], alone[alone > 0.0])


def test_a_sheet_without_thickness_is_seen():
    depth, box = RaycastCamera([solid((3.0, 0.0, 0.5), (0.0, 2.0, 2.0))], CAMERA).first_boxes(look(0.0, 0.0, 0.0))
    assert depth[24, 32] == 3.0 and box[24, 32] == 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("entry", [(0, 3), (1, 1)])
def test_an_invalid_pose_is_refused(value, entry):
    T_world_cam = look(1.0, 1.0, 0.3)
    T_world_cam[entry] = value
    with pytest.raises(InputError, match="T_world_cam"):
        RaycastCamera(room(4.0, 4.0, 2.5), CAMERA).render(T_world_cam)


def test_a_camera_in_an_empty_scene_is_refused():
    with pytest.raises(InputError, match="boxes"):
        RaycastCamera([], CAMERA)


@given(st.floats(0.3, 2.7), st.floats(0.3, 3.7), angles)
def test_embree_and_mujoco_agree(x, y, heading):
    apartment = two_rooms(pieces=(furniture("table", (2.0, 1.0, 0.3), (0.6, 0.4, 0.6), 0.5),))
    T_world_cam = look(x, y, heading)
    rays = (np.asarray(CAMERA.rays(), dtype=np.float64).reshape(-1, 3) @ T_world_cam[:3, :3].T).astype(np.float32)
    (t, box), (t_mujoco, box_mujoco) = (
        tracer.trace(T_world_cam[:3, 3], rays)
        for tracer in (EmbreeTracer(apartment.boxes()), MujocoTracer(FloorWorld(apartment, ROBOT)))
    )
    close = np.abs(t - t_mujoco) <= 1e-4
    assert np.mean(close) > 0.998  # the rest: rays through an edge
    assert np.mean(box[close] == box_mujoco[close]) > 0.99


def test_where_nothing_is_hit_depth_is_zero_and_the_sky_shows():
    rgb, depth = RaycastCamera([solid((3.0, 0.0, 0.0), (0.2, 0.2, 0.2))], CAMERA).render(look(0.0, 0.0, 0.0))
    assert 0.0 < np.mean(depth > 0.0) < 0.1
    assert (rgb[depth == 0.0] == np.round(255 * np.array(shading.SKY))).all()
    assert depth.dtype == np.float32 and rgb.dtype == np.uint8


def quarters(names):
    """Return a picture with red upper left, green upper right, blue lower left, white lower right."""
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


def test_a_wall_in_two_pieces_has_the_texture_of_one():
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
    """Sampling averages the tiles that a pixel covers, because aliasing would mislead a tracker."""
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
    camera = RaycastCamera(SHELL, CAMERA)
    rgb, depth = camera.render(look(1.0, 1.0, 0.4))
    again = pickle.loads(pickle.dumps(camera)).render(look(1.0, 1.0, 0.4))
    assert rgb.tobytes() == again[0].tobytes() and depth.tobytes() == again[1].tobytes()


def test_without_embree_the_fallback_warns(monkeypatch):
    world = FloorWorld(two_rooms(), ROBOT)
    assert make_tracer(world).name == "embree"
    monkeypatch.setitem(sys.modules, "embreex", None)  # makes the import fail as it does without a wheel
    with pytest.warns(RuntimeWarning, match="embreex cannot be imported"):
        tracer = make_tracer(world)
    assert tracer.name == "mujoco" and not tracer.parallel


@pytest.mark.parametrize(("field", "value"), [("width", 0), ("height", 12.5), ("hfov", 4.0), ("hfov", math.nan)])
def test_a_bad_camera_is_named(field, value):
    with pytest.raises(InputError, match=field):
        CameraConfig(**{field: value})
