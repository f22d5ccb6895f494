"""What :mod:`~vssm_gym.inference.prism.filter` is told, and the motion model of a hand."""

from dataclasses import dataclass, field

from vssm_gym.errors import InputError
from vssm_gym.inference.mapping.map_update import MapUpdateConfig
from vssm_gym.inference.tracking.camera_filter import COMMANDED, TrackingConfig
from vssm_gym.inference.tracking.recovery import RecoveryConfig
from vssm_gym.model.transition.rigid import Rigid, RigidNoise

HAND = Rigid(RigidNoise(0.15, 0.01, 0.3, 0.01))  # constant velocity with the unrest of a hand; PRISM's is ``Rigid()``


@dataclass(frozen=True)
class PrismConfig:
    """Effort, and what the filter believes. The defaults are those of a hand-held camera."""

    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    recovery: RecoveryConfig | None = field(default_factory=RecoveryConfig)  # None: wait where the body is expected
    samples: int = 1  # odd, of the pose in the map update; from 3 on the map's uncertainty also widens the residuals
    track_width: int | None = 160  # pixels, of the images that are tracked; the map takes them whole; None: whole too
    anchor_distance: float = 0.15  # m and
    anchor_angle: float = 0.15  # rad: the anchor serves until the camera is farther from it than either
    window_margin: float | None = 0.25  # of the map's edge: beyond it from the middle the window follows; None: never

    def __post_init__(self) -> None:
        if self.samples < 1 or self.samples % 2 == 0:
            expected = "an odd number: the mean, and pairs on either side of it, so that the map does not move"
            raise InputError("PrismConfig", "samples", f"{expected}; found {self.samples!r}")


HAND_HELD = PrismConfig()
# For a robot whose commands are known. An image that does not fit leaves the map as it is, and the pose follows the
# commands; the next ones are compared with the map where the robot is expected to be, until one fits.
ROBOT = PrismConfig(tracking=COMMANDED, recovery=None, window_margin=None, track_width=None)
