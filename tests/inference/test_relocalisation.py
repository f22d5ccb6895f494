"""Test relocalisation from nowhere: the right place is found, look-alikes are said to be, blank images are not used."""

import math
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from tests.helpers.planning_worlds import APART, DEPTH, WIDTH, twin_rooms, voxel_map
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix, wrap_angle
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.relocalisation.cylinder import Cylinder
from vssm_gym.inference.relocalisation.likelihood import ComparisonConfig, compare, peaks
from vssm_gym.inference.relocalisation.panoramas import Panoramas
from vssm_gym.inference.relocalisation.relocaliser import Hypothesis, Outcome, Relocaliser
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import RGBD
from vssm_gym.model.transition import MotionNoise, Planar

ROBOT = HolonomicRobot()
RIG = Rig.of(Camera.from_hfov(64, 48, math.radians(90.0)), ROBOT.T_body_cam)
RANGE = 8.0  # m
TRANSITION = Planar(MotionNoise(0.05, 0.02))
STAND = np.zeros(3)


def grid(low: tuple[float, float], high: tuple[float, float], spacing: float = 0.25) -> np.ndarray:
    axes = [np.arange(a, b, spacing) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def look(m: VoxelMap, planar: np.ndarray, gain: float = 1.0) -> RGBD:
    """Return the image that the robot would take, as a camera of another gain delivers it."""
    T = jnp.asarray(planar_to_matrix(planar) @ ROBOT.T_body_cam, jnp.float32)
    image = emission.render(m, T, RIG.camera, RANGE)
    rgb = np.round(np.clip(gain * np.asarray(image.rgb), 0.0, 1.0) * 255.0).astype(np.uint8)
    return RGBD.from_camera(rgb, np.asarray(image.depth))


def off(planar: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return m and rad between two poses."""
    return float(np.hypot(*(planar[:2] - truth[:2]))), abs(float(wrap_angle(planar[2] - truth[2])))


def assert_near(planar: np.ndarray, truth: np.ndarray) -> None:
    metres, radians = off(planar, truth)
    assert metres < 0.1
    assert radians < math.radians(5.0)


@pytest.fixture(scope="module")
def flat() -> VoxelMap:
    wall, table = shapely.box(2.45, 0.0, 2.55, 2.1), shapely.box(3.4, 0.9, 4.0, 1.5)
    return voxel_map(shapely.box(0.0, 0.0, 5.0, 3.0), [(wall, 0.0, 1.0), (table, 0.0, 0.7)])


@pytest.fixture(scope="module")
def finder(flat: VoxelMap) -> Relocaliser:
    return Relocaliser.of(flat, RIG, grid((0.3, 0.3), (4.8, 2.8)), RANGE)


@pytest.fixture(scope="module")
def twins() -> Relocaliser:
    places = grid((0.3, 0.3), (WIDTH - 0.2, DEPTH - 0.2))
    return Relocaliser.of(
        twin_rooms(differ=False), RIG, np.concatenate([places, places + np.array([APART, 0.0])]), RANGE
    )


@pytest.mark.slow
@pytest.mark.parametrize("columns", [0, 7, 60, 119])
def test_an_image_is_a_window_of_the_panorama_at_its_place(columns, flat):
    """The two are rendered along different rays and agree but for edges; at another heading they do not."""
    cylinder, place = Cylinder.of(RIG), np.array([1.2, 1.4])
    image = look(flat, np.array([*place, columns * cylinder.config.step]))
    ring = cylinder.resample(np.asarray(image.rgb), np.asarray(image.depth))
    panoramas = Panoramas.of(flat, cylinder, place[None], RANGE)
    start = (columns + cylinder.first) % cylinder.config.columns
    window = panoramas.ring.log_range[:, 0, start : start + cylinder.columns]
    both = (ring.read > 0) & (panoramas.ring.seen[:, 0, start : start + cylinder.columns] > 0)
    assert both.mean() > 0.6
    assert np.median(np.abs(ring.log_range - window)[both]) < 0.02
    scores = compare(ring, panoramas, cylinder, ComparisonConfig())
    assert int(np.argmax(scores[0])) == columns


def test_a_window_never_wraps_wrongly(flat):
    """A turn of the panorama by a column turns the scores by a column."""
    cylinder = Cylinder.of(RIG)
    image = look(flat, np.array([1.0, 1.0, 0.3]))
    ring = cylinder.resample(np.asarray(image.rgb), np.asarray(image.depth))
    panoramas = Panoramas.of(flat, cylinder, grid((0.5, 0.5), (2.0, 2.0), 0.5), RANGE)
    turned = replace(panoramas, ring=type(panoramas.ring)(*(np.roll(a, 1, axis=-1) for a in panoramas.ring)))
    scores, after = (compare(ring, p, cylinder, ComparisonConfig()) for p in (panoramas, turned))
    np.testing.assert_allclose(np.roll(scores, 1, axis=-1), after, atol=1e-5)


def test_candidates_are_apart_and_in_order(flat):
    cylinder, config = Cylinder.of(RIG), ComparisonConfig()
    panoramas = Panoramas.of(flat, cylinder, grid((0.5, 0.5), (2.0, 2.0)), RANGE)
    scores = np.random.default_rng(0).normal(size=(len(panoramas.places), cylinder.config.columns))
    found = peaks(scores, panoramas.places, cylinder.config.step, config)
    values = [scores[one] for one in found]
    assert values == sorted(values, reverse=True)
    assert values[0] == scores.max()
    for i, (p, h) in enumerate(found):
        for q, k in found[:i]:
            metres = np.hypot(*(panoramas.places[p] - panoramas.places[q]))
            turned = abs(float(wrap_angle((h - k) * cylinder.config.step)))
            assert metres >= config.apart or turned >= config.apart_heading - cylinder.config.step


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("gain", [1.0, 0.85])
def test_a_robot_is_found_from_nowhere(seed, gain, flat, finder):
    rng = np.random.default_rng(seed)
    x = rng.uniform(*((0.4, 2.0) if seed % 2 else (2.9, 3.2)))
    truth = np.array([x, rng.uniform(0.5, 2.5), rng.uniform(-math.pi, math.pi)])
    found = finder.find(look(flat, truth, gain))
    assert_near(found.hypotheses[0].planar, truth)
    if found.outcome is Outcome.FOUND:
        assert found.belief is not None
        std = np.sqrt(np.diag(np.asarray(found.belief.covariance)))
        assert np.all((std > 0.0) & (std < 0.1))
    else:
        assert found.belief is None


@pytest.mark.slow
def test_most_poses_are_accepted(flat, finder):
    rng, accepted = np.random.default_rng(7), 0
    for _ in range(12):
        truth = np.array([rng.uniform(0.5, 1.9), rng.uniform(0.5, 2.5), rng.uniform(-math.pi, math.pi)])
        accepted += finder.find(look(flat, truth)).outcome is Outcome.FOUND
    assert accepted >= 8


@pytest.mark.parametrize("depth", [0.0, 1.0, np.nan])
@pytest.mark.parametrize("grey", [0, 128])
def test_an_image_that_shows_nothing_is_not_used(depth, grey, finder):
    """Black images, and grey cards that fill the view."""
    height, width = RIG.camera.height, RIG.camera.width
    rgb = np.full((height, width, 3), grey, np.uint8)
    blank = RGBD.from_camera(rgb, np.full((height, width), depth, np.float32))
    assert finder.find(blank).outcome is Outcome.NOTHING
    assert finder.find_picture(rgb / np.float32(255.0)).outcome is Outcome.NOTHING


@pytest.mark.parametrize("seed", range(3))
def test_a_false_image_is_not_accepted(seed, flat, finder):
    """Colours of another view, a mirrored image, or noise."""
    rng = np.random.default_rng(seed)
    a, b = (look(flat, np.array([1.0, 1.2, h])) for h in rng.uniform(-math.pi, math.pi) + np.array([0.0, 2.0]))
    swapped = replace_rgb(a, b.rgb)
    mirrored = RGBD(a.depth[:, ::-1], a.rgb[:, ::-1], a.hit[:, ::-1], a.known[:, ::-1])
    noise = replace_rgb(a, jnp.asarray(rng.uniform(size=a.rgb.shape), jnp.float32))
    for false in (swapped, mirrored, noise):
        assert finder.find(false).outcome is not Outcome.FOUND


def replace_rgb(image: RGBD, rgb: jnp.ndarray) -> RGBD:
    return RGBD(image.depth, rgb, image.hit, image.known)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("east", [False, True])
def test_equal_rooms_are_ambiguous_and_both_are_hypotheses(seed, east, twins):
    rng = np.random.default_rng(seed)
    truth = np.array([rng.uniform(0.8, 2.2), rng.uniform(0.8, 1.6), rng.uniform(-math.pi, math.pi)])
    truth[0] += APART * east
    found = twins.find(look(twins.map, truth))
    assert found.outcome is Outcome.AMBIGUOUS
    assert found.belief is None
    here = [one for one in found.hypotheses if off(one.planar, truth)[0] < 0.1]
    twin = truth + np.array([APART * (1 - 2 * east), 0.0, 0.0])
    there = [one for one in found.hypotheses if off(one.planar, twin)[0] < 0.1]
    assert here
    assert there


@pytest.mark.slow
def test_a_later_view_decides_between_rooms_that_differ_in_one_wall():
    """The robot stands in the east room, looks away from its east wall, and turns to it."""
    m = twin_rooms(differ=True)
    places = grid((0.3, 0.3), (WIDTH - 0.2, DEPTH - 0.2))
    finder = Relocaliser.of(m, RIG, np.concatenate([places, places + np.array([APART, 0.0])]), RANGE)
    planar, turn = np.array([1.5 + APART, 1.2, math.pi]), np.array([0.2, 0.0, 0.0])
    found = finder.find(look(m, planar))
    assert found.outcome is Outcome.AMBIGUOUS
    for _ in range(16):
        planar = planar + np.array([0.0, 0.0, turn[0]])
        found = finder.narrowed(found.hypotheses, turn, TRANSITION, 0.2, look(m, planar))
        if found.outcome is Outcome.FOUND:
            break
        assert any(off(one.planar, planar)[0] < 0.1 for one in found.hypotheses)  # the right one is kept
    assert found.outcome is Outcome.FOUND
    assert_near(found.hypotheses[0].planar, planar)


def test_hypotheses_follow_the_commands_while_images_show_nothing(twins):
    hypotheses = [Hypothesis(np.array([1.0, 1.0, 0.5]), 2.0), Hypothesis(np.array([4.5, 1.0, 0.5]), 1.9)]
    height, width = RIG.camera.height, RIG.camera.width
    dark = RGBD.from_camera(np.zeros((height, width, 3), np.uint8), np.zeros((height, width), np.float32))
    command = np.array([0.1, 0.0, 0.15])
    found = twins.narrowed(hypotheses, command, TRANSITION, 0.2, dark)
    assert found.outcome is Outcome.AMBIGUOUS
    for before, after in zip(hypotheses, found.hypotheses, strict=True):
        expected = TRANSITION.expected(jnp.asarray(before.planar, jnp.float32), jnp.asarray(command, jnp.float32), 0.2)
        np.testing.assert_allclose(after.planar, np.asarray(expected), atol=1e-5)
        assert after.log_prob == before.log_prob


@pytest.mark.parametrize("seed", range(6))
def test_the_place_of_a_picture_is_found_without_depth(seed, flat, finder):
    rng = np.random.default_rng(seed)
    truth = np.array([rng.uniform(0.6, 1.8), rng.uniform(0.6, 2.4), rng.uniform(-math.pi, math.pi)])
    while float(np.median(np.asarray(look(flat, truth).depth))) < 1.0:  # as open as the images of ImageNav
        truth[2] += 0.5
    rgb = np.asarray(look(flat, truth, gain=0.9).rgb)
    found = finder.find_picture(rgb)
    assert found.belief is None
    assert_near(found.hypotheses[0].planar, truth)
    near = truth + np.array([0.1, -0.05, 0.05])
    assert finder.shows_picture(look(flat, near), near, rgb, truth)
    away = truth + np.array([0.0, 0.0, math.pi])
    assert not finder.shows_picture(look(flat, away), truth, rgb, truth)


def test_a_picture_of_equal_rooms_is_ambiguous(twins):
    truth = np.array([1.4, 1.2, 0.4])
    found = twins.find_picture(np.asarray(look(twins.map, truth).rgb))
    assert found.outcome is Outcome.AMBIGUOUS
    assert min(off(one.planar, truth)[0] for one in found.hypotheses[:2]) < 0.1
    assert min(off(one.planar, truth + np.array([APART, 0.0, 0.0]))[0] for one in found.hypotheses[:2]) < 0.1


@pytest.mark.parametrize("places", [np.empty((0, 2)), np.full((3, 2), np.nan)])
def test_places_must_be_places(places, flat):
    with pytest.raises(InputError, match="places"):
        Relocaliser.of(flat, RIG, places)


def test_a_camera_that_looks_down_has_no_panorama():
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    with pytest.raises(InputError, match="level"):
        Cylinder.of(Rig.of(RIG.camera, T))
