"""Define what robots measure: one file a sensor, one row each in :mod:`.registry`, and :class:`.suite.SensorSuite`, the
list that an environment holds. The configuration of the camera is offered here.
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
