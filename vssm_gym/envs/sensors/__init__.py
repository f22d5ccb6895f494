"""Define the sensors of robots: one file each, one row each in :mod:`.registry`, held in a :class:`.suite.SensorSuite`.

The camera's configuration is exported here.
"""

from vssm_gym.envs.sensors.camera import (
    RENDERERS,
    CameraConfig,
    SceneCamera,
    camera_config,
    make_camera,
    make_tracer,
)

__all__ = ["RENDERERS", "CameraConfig", "SceneCamera", "camera_config", "make_camera", "make_tracer"]
