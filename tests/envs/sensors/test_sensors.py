"""Test the configuration of the camera in every form, and the smallest images."""

import math

import numpy as np
import pytest

from tests.helpers.box_rooms import two_rooms
from vssm_gym.envs.physics import FloorWorld
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.sensors import CameraConfig, camera_config, make_camera
from vssm_gym.envs.sensors.rgbd_noise import NoisySensor, sensor_noise
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import planar_to_matrix

WORLD = FloorWorld(two_rooms(), HolonomicRobot())


def test_a_camera_is_configured_by_itself_a_mapping_or_nothing() -> None:
    assert camera_config(None) == camera_config({}) == CameraConfig()
    assert camera_config({"width": 80, "height": 60, "hfov": 1.0}) == CameraConfig(80, 60, 1.0)
    assert camera_config({"hfov": 1}).hfov == 1
    assert camera_config(CameraConfig(32, 24)) == CameraConfig(32, 24)


@pytest.mark.parametrize(
    "spec", [{"widht": 80}, {"rate": 10.0}, (160, 120), "small", 160, {1: 2}, [("width", 80)], CameraConfig]
)
def test_anything_else_is_one_clear_error(spec) -> None:
    with pytest.raises(InputError, match="CameraConfig, or a mapping of width, height, hfov"):
        camera_config(spec)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("width", 7), ("width", True), ("height", 0), ("height", 12.5), ("height", 10**9)),
        *(("hfov", 4.0), ("hfov", math.nan), ("hfov", "wide"), ("hfov", None)),
    ],
)
def test_a_bad_field_is_named(field, value) -> None:
    with pytest.raises(InputError, match=f"CameraConfig: {field}"):
        camera_config({field: value})


def test_an_unknown_renderer_is_refused() -> None:
    with pytest.raises(InputError, match="one of 'raycast', 'gl'; found 'vulkan'"):
        make_camera(WORLD.boxes, CameraConfig(), "vulkan")


@pytest.mark.parametrize(("width", "height"), [(64, 1), (8, 1), (8, 64), (9, 2), (17, 5)])
@pytest.mark.parametrize("noise", ["none", "kinect", "stereo"])
def test_images_of_any_size_are_measured(width, height, noise) -> None:
    """A scan is an image of one row; its readings are the wall within the noise."""
    eye = make_camera(WORLD.boxes, CameraConfig(width, height, 1.2))
    rgb, depth = eye.render(planar_to_matrix(np.array([1.0, 1.0, 0.3])) @ HolonomicRobot().T_body_cam)
    assert rgb.shape == (height, width, 3) and depth.shape == (height, width) and depth.min() > 0.0
    seen, z = NoisySensor(sensor_noise(noise), eye.camera, np.random.default_rng(0))(rgb, depth, 0.2)
    assert seen.shape == rgb.shape and seen.dtype == np.uint8 and z.shape == depth.shape and z.dtype == np.float32
    read = z > 0.0
    assert np.isfinite(z).all() and read.mean() > 0.2
    assert np.median(np.abs(z - depth)[read]) < 0.05
    eye.close()
