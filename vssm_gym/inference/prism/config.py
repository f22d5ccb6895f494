"""Configure :mod:`~vssm_gym.inference.prism.filter`, and define the motion model of a hand-held camera."""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

from vssm_gym.errors import InputError
from vssm_gym.inference.mapping.map_update import MapUpdateConfig
from vssm_gym.inference.tracking.config import COMMANDED, TrackingConfig
from vssm_gym.inference.tracking.recovery import RecoveryConfig
from vssm_gym.model.transition.rigid import Rigid, RigidNoise

HAND = Rigid(RigidNoise(0.15, 0.01, 0.3, 0.01))  # constant velocity with a hand's accelerations; PRISM's: ``Rigid()``


@runtime_checkable
class SensorErrors(Protocol):
    """State standard deviations of errors that all images share."""

    @property
    def stamp_std(self) -> float:
        """Return that of an image's time stamp, s."""

    @property
    def calibration_std(self) -> float:
        """Return that of the pose by intrinsics and mounting, m and rad."""

    @property
    def scale_std(self) -> float:
        """Return that of the depth's scale, as a proportion."""


@dataclass(frozen=True)
class PrismConfig:
    """Configure effort and beliefs of the filter. The defaults are those of a hand-held camera."""

    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    recovery: RecoveryConfig | None = field(default_factory=RecoveryConfig)  # None: retry at the predicted pose only
    samples: int = 1  # odd, of the pose in the map update; from 3 on the map's uncertainty also widens the residuals
    track_width: int | None = 160  # pixels: images are tracked at this width and mapped at their own; None: unchanged
    reference_distance: float = 0.15  # m and
    reference_angle: float = 0.15  # rad: the reference view serves until the camera is farther from it than either
    stamp_std: float = 0.01  # s, of an image's time stamp: colour and depth are taken up to half a frame apart
    calibration_std: float = 0.003  # m and rad, of the pose by the intrinsics and by where the camera is on its body
    scale_std: float = 0.005  # of the depth's scale, by which all of the map is larger or smaller about its first image
    # An image whose surfaces the map knows by this share at most cannot contradict it. Of a body that follows commands
    # it is added where they have led, if it has so many readings and the pose is known so well.
    new_coverage: float = 0.1
    new_reading: float = 0.25
    known_std: float = 0.06  # m and rad
    window_margin: float | None = 0.25  # of the map's edge: the window moves beyond this from its middle; None: never

    def __post_init__(self) -> None:
        if self.samples < 1 or self.samples % 2 == 0:
            expected = "an odd number: the mean and symmetric pairs around it, so that the map does not move"
            raise InputError("PrismConfig", "samples", f"{expected}; found {self.samples!r}")


HAND_HELD = PrismConfig()
# For a robot whose commands are known. After an image that is not accepted, the map stays unchanged and the pose
# follows the commands; the next images are compared with the map at the predicted pose, until one is accepted.
ROBOT_PRISM = PrismConfig(
    tracking=COMMANDED,
    recovery=None,
    window_margin=None,
    track_width=None,
    stamp_std=0.0,
    calibration_std=0.0,
    scale_std=0.0,
)
