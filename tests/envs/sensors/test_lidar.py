"""Test the laser scanner: ranges in a room by hand, its noise against the stated law, its conventions."""

import math
import pickle
import sys
from dataclasses import fields, replace

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import vssm_gym  # noqa: F401  (registers the environments)
from tests.helpers.box_rooms import two_rooms
from vssm_gym.envs.physics import FloorWorld
from vssm_gym.envs.physics.tracing import EmbreeTracer, MujocoTracer
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.sensors import make_tracer
from vssm_gym.envs.sensors.lidar import PRESETS, Lidar, LidarConfig, LidarNoise, lidar_noise, measured
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import planar_to_matrix

ROOMS = two_rooms()  # the west room is [0.05, 2.95] x [0.05, 3.95], with a door at y in [1.5, 2.4] to the east
TRACER = EmbreeTracer(ROOMS.boxes())


def at(x: float, y: float, heading: float) -> np.ndarray:
    return planar_to_matrix(np.array([x, y, heading]))


def test_beams_fill_their_angle_evenly() -> None:
    for beams, fov in ((64, 2 * math.pi), (1, 1.0), (5, math.pi)):
        angles = LidarConfig(beams=beams, fov=fov).angles()
        assert angles.mean() == pytest.approx(0.0, abs=1e-12)
        np.testing.assert_allclose(np.diff(angles), fov / beams)
        assert angles[-1] - angles[0] == pytest.approx(fov - fov / beams)
    np.testing.assert_allclose(LidarConfig(beams=4).angles(), np.array([-135, -45, 45, 135]) * math.pi / 180)


@given(st.floats(0.1, 2.9), st.floats(0.1, 1.4), st.floats(-math.pi, math.pi))
def test_ranges_are_those_of_the_room(x: float, y: float, heading: float) -> None:
    """Every hit lies on the wall of the west room, or beyond its door; counter-clockwise from the robot's heading."""
    config = LidarConfig(beams=90, height=0.4)
    ranges = Lidar(config, TRACER).scan(at(x, y, heading))
    angle = heading + config.angles()
    hit = np.array([x, y]) + ranges[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    to_wall = np.stack([hit[:, 0] - 0.05, 2.95 - hit[:, 0], hit[:, 1] - 0.05, 3.95 - hit[:, 1]])
    through = hit[:, 0] > 2.95 + 1e-4
    assert ranges.dtype == np.float32 and (ranges > 0.0).all()
    np.testing.assert_allclose(to_wall.min(axis=0)[~through], 0.0, atol=1e-4)
    crossing = y + (2.95 - x) * np.tan(angle[through])  # what is beyond was seen through the doorway
    assert ((crossing > 1.5 - 1e-3) & (crossing < 2.4 + 1e-3)).all()


def test_the_fan_is_fixed_to_the_body() -> None:
    """A robot rolled by 180 degrees scans the other way round, at its height below its origin."""
    upright = at(1.0, 1.0, 0.4)
    upright[2, 3] = 1.0
    rolled = upright @ np.diag([1.0, -1.0, -1.0, 1.0])
    config = LidarConfig(beams=33, height=0.3)
    scan = Lidar(config, TRACER).scan
    np.testing.assert_allclose(scan(rolled), scan(upright)[::-1], atol=1e-5)  # walls are upright: height is no matter


def test_out_of_range_is_zero() -> None:
    """No reading is 0, as in depth images: beyond ``max_range``, within ``min_range``, into the void."""
    full = Lidar(LidarConfig(beams=360), TRACER).scan(at(1.0, 1.0, 0.0))
    short = Lidar(LidarConfig(beams=360, min_range=1.0, max_range=2.0), TRACER).scan(at(1.0, 1.0, 0.0))
    inside = (full >= 1.0) & (full <= 2.0)
    assert 0.0 < inside.mean() < 1.0
    np.testing.assert_array_equal(short, np.where(inside, full, 0.0))
    assert (Lidar(LidarConfig(height=9.0), TRACER).scan(at(1.0, 1.0, 0.0)) == 0.0).all()


def test_both_tracers_see_the_same(monkeypatch) -> None:
    world = FloorWorld(ROOMS, HolonomicRobot())
    config = LidarConfig(beams=128)
    scans = [Lidar(config, tracer).scan(at(1.2, 2.0, 0.3)) for tracer in (TRACER, MujocoTracer(world))]
    assert np.mean(np.abs(scans[0] - scans[1]) > 1e-4) < 0.02  # the rest: beams along an edge
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.warns(RuntimeWarning, match="embreex cannot be imported"):
        assert make_tracer(world).name == "mujoco"


@pytest.mark.parametrize("name", ["hokuyo", "rplidar"])
@pytest.mark.parametrize("distance", [0.5, 2.0, 6.0])
def test_ranges_err_by_their_law(name: str, distance: float) -> None:
    """``N(r, (floor + growth r)^2)``, the stated share lost, one beam's error independent of the next one's."""
    noise, config = PRESETS[name], LidarConfig(beams=100, noise=name)
    rng = np.random.default_rng(0)
    read = np.stack([measured(np.full(100, distance, np.float32), config, rng) for _ in range(1000)])
    got = read > 0.0
    assert np.mean(~got) == pytest.approx(noise.dropout, abs=0.002)
    error = (read[got] - distance) / (noise.floor + noise.growth * distance)
    assert error.mean() == pytest.approx(0.0, abs=0.015) and error.std() == pytest.approx(1.0, abs=0.01)
    both = got[:, 1:] & got[:, :-1]
    product = (read[:, 1:] - distance) * (read[:, :-1] - distance)
    assert np.mean(product[both]) / read[got].var() == pytest.approx(0.0, abs=0.02)


def test_noise_never_leaves_the_range_and_makes_no_reading_from_nothing() -> None:
    config = LidarConfig(beams=1000, min_range=0.2, max_range=5.0, noise=LidarNoise(floor=0.1))
    ranges = np.tile(np.array([0.0, 0.21, 4.99, 3.0], np.float32), 250)
    read = measured(ranges, config, np.random.default_rng(1))
    assert ((read == 0.0) | ((read >= 0.2) & (read <= 5.0))).all()
    assert (read[ranges == 0.0] == 0.0).all()
    assert 0.2 < np.mean(read[ranges == np.float32(4.99)] == 0.0) < 0.7


def test_without_noise_ranges_are_exact_and_a_seed_gives_its_bytes() -> None:
    config, ranges = LidarConfig(), Lidar(LidarConfig(), TRACER).scan(at(1.0, 1.0, 0.0))
    np.testing.assert_array_equal(measured(ranges, config, np.random.default_rng(0)), ranges)
    one, two = (measured(ranges, replace(config, noise="rplidar"), np.random.default_rng(5)) for _ in range(2))
    assert one.tobytes() == two.tobytes() and one.dtype == np.float32


@pytest.mark.parametrize(
    "change",
    [
        *({"beams": 0}, {"beams": 2.0}, {"beams": True}, {"fov": 0.0}, {"fov": 7.0}, {"fov": math.nan}),
        *({"max_range": math.inf}, {"max_range": 0.0}, {"min_range": 20.0}, {"height": math.nan}),
    ],
)
def test_an_impossible_scanner_is_refused(change: dict) -> None:
    with pytest.raises(InputError, match="LidarConfig"):
        LidarConfig(**change)


@pytest.mark.parametrize("change", [{"floor": -1.0}, {"growth": math.nan}, {"dropout": 1.1}, {"dropout": math.inf}])
def test_impossible_noise_is_refused(change: dict) -> None:
    with pytest.raises(InputError, match="LidarNoise"):
        LidarNoise(**change)
    with pytest.raises(InputError, match="one of none, hokuyo, rplidar"):
        lidar_noise("perfect")


CONFIG = LidarConfig(beams=45, fov=math.pi, max_range=3.0, height=0.4)


@pytest.mark.parametrize("name", ["PointNav", "ImageNav", "Explore"])
def test_a_robot_can_have_a_scanner(name: str) -> None:
    """Its scan is that of its true pose, and its noise changes neither image nor motion."""
    keywords = {"scene": ROOMS, "camera": {"width": 32, "height": 24}, "noise": "mid", "sensor_noise": "kinect"}
    plain = gym.make(f"vssm_gym/{name}-v0", **keywords)
    exact = gym.make(f"vssm_gym/{name}-v0", sensors=[CONFIG], **keywords)
    asked = {"sensor": "lidar"} | {field.name: getattr(CONFIG, field.name) for field in fields(CONFIG)}
    noisy = gym.make(f"vssm_gym/{name}-v0", sensors=[asked | {"noise": "rplidar"}], **keywords)
    assert "scan" not in plain.observation_space.spaces
    action = np.array([0.2, 0.0, 0.1, 0.0], np.float32)
    for step in range(3):
        (a, *_), (b, *_), (c, *_) = (
            env.reset(seed=4) if step == 0 else env.step(action) for env in (plain, exact, noisy)
        )
        assert exact.observation_space.contains(b) and noisy.observation_space.contains(c)
        pose = planar_to_matrix(exact.unwrapped.simulation.planar)
        np.testing.assert_array_equal(b["scan"], Lidar(CONFIG, TRACER).scan(pose))
        assert (b["scan"] != c["scan"]).mean() > 0.5
        for key in a:
            np.testing.assert_array_equal(a[key], b[key])
            np.testing.assert_array_equal(a[key], c[key])
    twin = pickle.loads(pickle.dumps(noisy.unwrapped))
    np.testing.assert_array_equal(twin.step(action)[0]["scan"], noisy.unwrapped.step(action)[0]["scan"])


def test_scanners_in_a_vector_environment_scan_as_single_ones() -> None:
    keywords = {
        "scene": ROOMS,
        "camera": {"width": 32, "height": 24},
        "sensors": [{"sensor": "lidar", "noise": "hokuyo"}],
    }
    vector = gym.make_vec("vssm_gym/PointNav-v0", num_envs=2, **keywords)
    scans = vector.reset(seed=1)[0]["scan"]
    assert scans.shape == (2, 64)
    for i in range(2):
        alone = gym.make("vssm_gym/PointNav-v0", **keywords).reset(seed=1 + i)[0]
        np.testing.assert_array_equal(scans[i], alone["scan"])
    vector.close()


@pytest.mark.parametrize("fields", [{"rays": 5}, {"beams": 0}, {"fov": "wide"}, {"noise": "loud"}])
def test_an_invalid_scanner_is_refused(fields: dict) -> None:
    with pytest.raises(InputError, match=r"lidar|LidarConfig"):
        gym.make("vssm_gym/PointNav-v0", scene=ROOMS, sensors=[{"sensor": "lidar", **fields}])


@pytest.mark.parametrize("keyword", ["lidar", "lidar_noise"])
@pytest.mark.parametrize("name", ["PointNav", "ImageNav", "Explore"])
def test_the_keywords_of_earlier_versions_name_the_new_one(name: str, keyword: str) -> None:
    with pytest.raises(InputError, match=rf'{keyword}: expected sensors=\["lidar"\]'):
        gym.make(f"vssm_gym/{name}-v0", **{keyword: True})
