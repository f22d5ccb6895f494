"""Test that keywords for presets take a name, the object or a mapping of its fields, and refuse the rest."""

from dataclasses import asdict

import pytest

from vssm_gym.envs.flight_body import flight_noise
from vssm_gym.envs.maze_noise import motion_noise, range_noise
from vssm_gym.envs.presets import Presets
from vssm_gym.envs.robots import execution_noise
from vssm_gym.envs.robots.car_noise import car_noise
from vssm_gym.envs.sensors import CameraConfig, camera_config
from vssm_gym.envs.sensors.imu import imu_noise
from vssm_gym.envs.sensors.lidar import lidar_noise
from vssm_gym.envs.sensors.rgbd_noise import sensor_noise
from vssm_gym.errors import InputError

ALL = [
    *(car_noise, flight_noise, imu_noise, motion_noise, range_noise, execution_noise, sensor_noise, lidar_noise),
    camera_config,
]
NAMED = [(presets, name) for presets in ALL for name in presets.named]


@pytest.mark.parametrize(("presets", "name"), NAMED, ids=lambda value: getattr(value, "field", value))
def test_a_name_an_object_and_its_fields_are_equivalent(presets: Presets, name: str) -> None:
    chosen = presets(name)
    assert chosen is presets.named[name]
    assert presets(chosen) is chosen
    assert presets(asdict(chosen)) == chosen


@pytest.mark.parametrize("presets", ALL, ids=lambda presets: presets.kind.__name__)
@pytest.mark.parametrize("value", ["loud", 3, None, [1, 2], {"rays": 5}, {1: 2}, ("none",), CameraConfig])
def test_an_error_names_the_keyword_and_the_presets(presets: Presets, value: object) -> None:
    if value is None and presets.default is not None:
        assert presets(value) == presets.default
        return
    with pytest.raises(InputError) as error:
        presets(value)
    assert (error.value.source, error.value.field) == (presets.source, presets.field)
    for word in (*presets.named, presets.kind.__name__, repr(value)):
        assert word in error.value.expected


@pytest.mark.parametrize("presets", ALL, ids=lambda presets: presets.kind.__name__)
def test_a_field_that_is_not_a_number_is_refused(presets: Presets) -> None:
    for field in asdict(presets.kind() if presets.default else next(iter(presets.named.values()))):
        with pytest.raises(InputError):
            presets({field: "wide"})
