"""List the sensors that a robot on the ground may carry besides its camera: name -> configuration class.

PointNav, ImageNav, Explore and CarNav take ``sensors=[...]`` of names, configurations, or mappings of a configuration's
fields such as ``{"sensor": "gps_compass", "noise": "low"}``. One more sensor is one file in this folder and one row.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from vssm_gym.envs.presets import Presets
from vssm_gym.envs.sensors.base import SensorConfig
from vssm_gym.envs.sensors.bumper import BumperConfig
from vssm_gym.envs.sensors.gps_compass import GpsCompassConfig
from vssm_gym.envs.sensors.lidar import LidarConfig
from vssm_gym.errors import InputError

SENSORS: dict[str, type[SensorConfig]] = {
    "lidar": LidarConfig,
    "gps_compass": GpsCompassConfig,
    "bumper": BumperConfig,
}


def parse_sensors(source: str, value: Any) -> list[SensorConfig]:
    """Return the configurations in the keyword ``sensors`` of the environment ``source``, in its order.

    Raises :class:`InputError` naming what is available for anything else, and for a sensor that is listed twice.
    """
    if isinstance(value, str | Mapping) or not isinstance(value, Sequence):
        raise InputError(source, "sensors", f"a list of sensors ({', '.join(SENSORS)}); found {value!r:.80}")
    configs = [_parse(source, one) for one in value]
    for i, config in enumerate(configs):
        if any(type(config) is type(other) for other in configs[:i]):
            raise InputError(source, "sensors", f"each sensor once; {_name(config)!r} occurs twice")
    return configs


def _parse(source: str, one: Any) -> SensorConfig:
    if type(one) in SENSORS.values():
        return one
    name = one.get("sensor") if isinstance(one, Mapping) else one
    if not isinstance(name, str) or name not in SENSORS:
        expected = f"names ({', '.join(SENSORS)}), configurations, or mappings with such a name as 'sensor'"
        raise InputError(source, "sensors", f"{expected}; found {one!r:.80}")
    given = {field: value for field, value in one.items() if field != "sensor"} if isinstance(one, Mapping) else {}
    kind = SENSORS[name]
    return Presets(source, f"sensors: {name}", kind, {})(given)


def _name(config: SensorConfig) -> str:
    return next(name for name, kind in SENSORS.items() if type(config) is kind)
