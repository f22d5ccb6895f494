"""Test the information of an image about the robot's own pose: closed forms of walls and corners, and invariance."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.analytic_room import Room, camera_pose
from vssm_gym.geometry.camera import Camera
from vssm_gym.planning.exploration.information import InformationConfig
from vssm_gym.planning.exploration.information.pose import pose_gain

STD = InformationConfig().measurement_std
CAMERA = Camera.from_hfov(40, 30, np.radians(75))
WALL = Room(((-50.0, -50.0, -50.0), (2.0, 50.0, 50.0)))  # x = 2, all around it nothing near
CORNER = Room(((-50.0, -50.0, -50.0), (2.0, 1.0, 50.0)))


def gain(room: Room, T: np.ndarray, std: tuple[float, float, float]) -> float:
    """Return the gain of one image whose every pixel shows a known surface."""
    depth = np.asarray(room.image(T, CAMERA).depth, np.float64)[None]
    return float(pose_gain(depth, np.ones(depth.shape, bool), T[None], CAMERA, np.array(std), STD)[0])


def test_a_known_pose_learns_nothing() -> None:
    assert gain(CORNER, camera_pose((0.0, 0.0, 0.4), 0.4), (0.0, 0.0, 0.0)) == 0.0


def test_a_wall_determines_the_distance_to_it_and_not_the_position_along_it() -> None:
    T, pixels = camera_pose((0.0, 0.0, 0.4), 0.0), (CAMERA.width - 1) * (CAMERA.height - 1)
    towards = 0.5 * np.log(1.0 + pixels * (0.1 / STD) ** 2)
    assert gain(WALL, T, (0.1, 0.0, 0.0)) == pytest.approx(towards, rel=1e-4)
    assert gain(WALL, T, (0.0, 0.1, 0.0)) == pytest.approx(0.0, abs=1e-3)


def test_the_information_about_a_turn_grows_with_the_lever_arm() -> None:
    """A turn by ``a`` brings the wall's point at ``y`` nearer by ``a y``."""
    T = camera_pose((0.0, 0.0, 0.4), 0.0)
    u = np.arange(CAMERA.width - 1)
    y = -(u - CAMERA.cx) / CAMERA.fx * 2.0
    fisher = (CAMERA.height - 1) * np.sum(y**2) / STD**2
    assert gain(WALL, T, (0.0, 0.0, 0.05)) == pytest.approx(0.5 * np.log(1.0 + 0.05**2 * fisher), rel=1e-3)


def test_a_corner_gives_more_information_than_a_wall() -> None:
    std = (0.05, 0.05, 0.1)
    T = camera_pose((0.5, 0.0, 0.4), 0.6)
    assert gain(CORNER, T, std) > gain(WALL, T, std) + 0.5
    assert gain(CORNER, T, (0.0, 0.05, 0.0)) > 1.0


def test_the_information_does_not_depend_on_the_number_of_pixels() -> None:
    T, fine = camera_pose((0.5, 0.0, 0.4), 0.6), Camera.from_hfov(120, 90, np.radians(75))
    depth = np.asarray(CORNER.image(T, fine).depth, np.float64)[None]
    std = np.array([0.05, 0.05, 0.1])
    many = pose_gain(depth, np.ones(depth.shape, bool), T[None], fine, std, STD)[0]
    assert many == pytest.approx(gain(CORNER, T, tuple(std)), rel=0.03)


def test_unknown_surfaces_have_no_information() -> None:
    T = camera_pose((0.5, 0.0, 0.4), 0.6)
    depth = np.asarray(CORNER.image(T, CAMERA).depth, np.float64)[None]
    std = np.array([0.05, 0.05, 0.1])
    half = np.zeros(depth.shape, bool)
    assert pose_gain(depth, half, T[None], CAMERA, std, STD)[0] == 0.0
    half[..., :20] = True
    whole = pose_gain(depth, np.ones(depth.shape, bool), T[None], CAMERA, std, STD)[0]
    assert 0.0 < pose_gain(depth, half, T[None], CAMERA, std, STD)[0] < whole


@given(turn=st.floats(-3.0, 3.0), xy=st.tuples(st.floats(-5, 5), st.floats(-5, 5)))
def test_the_gain_is_invariant_to_the_world_frame(turn: float, xy: tuple[float, float]) -> None:
    """Equal standard deviations along x and y: turning and shifting the world changes nothing."""
    T = camera_pose((0.5, 0.0, 0.4), 0.6)
    moved = camera_pose((*xy, 0.0), turn) @ np.linalg.inv(camera_pose((0.0, 0.0, 0.0), 0.0)) @ T
    depth = np.asarray(CORNER.image(T, CAMERA).depth, np.float64)[None]
    seen, std = np.ones(depth.shape, bool), np.array([0.05, 0.05, 0.1])
    here, there = (pose_gain(depth, seen, pose[None], CAMERA, std, STD) for pose in (T, moved))
    np.testing.assert_allclose(there, here, rtol=1e-6)
