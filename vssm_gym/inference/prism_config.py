"""What :mod:`~vssm_gym.inference.prism` is told: noise, solver, effort, and what it believes."""

from dataclasses import dataclass, field

from vssm_gym.errors import InputError
from vssm_gym.inference.alignment import AlignConfig
from vssm_gym.inference.map_update import MapUpdateConfig
from vssm_gym.inference.recovery import RecoveryConfig
from vssm_gym.inference.rotation import RotationConfig
from vssm_gym.transition.rigid import RigidNoise


@dataclass(frozen=True)
class PrismConfig:
    """Stds of the motion are those of a hand; SPEC 3's are ``RigidNoise()``."""

    # Flatter in depth than one pixel's noise: far points are few but they hold the rotation.
    align: AlignConfig = field(
        default_factory=lambda: AlignConfig(0.006, 0.001, edge=0.02, levels=(4, 2, 1), iterations=(6, 4, 4))
    )
    rotation: RotationConfig = field(default_factory=RotationConfig)
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    recovery: RecoveryConfig = field(default_factory=RecoveryConfig)
    noise: RigidNoise = field(default_factory=lambda: RigidNoise(0.15, 0.01, 0.3, 0.01))
    solver: str = "gauss_newton"  # a key of camera_filter.SOLVERS
    samples: int = 1  # odd, of the pose in the map update; from 3 on the map's uncertainty also widens the residuals
    smoothing: float = 0.8  # of the Laplace covariance over time
    track_width: int = 160  # pixels: images are shrunk to about this for tracking; the map takes them whole
    anchor_distance: float = 0.15  # m and
    anchor_angle: float = 0.15  # rad: the anchor serves until the camera is farther from it than either
    window_margin: float = 0.25  # of the map's edge: the window follows a camera farther than this from its middle
    min_reading: float = 0.05  # share of the pixels that have depth; an image with fewer has no reading
    min_score: float = 0.6  # of :func:`alignment.score`
    max_photometric: float = 5.0  # mean |r_rgb| / sigma; cells of 7 cm blur the rendered image by that much
    max_surprise: float = 12.0  # stds of the predicted pose: beyond them the camera jumped, and the prior would hold it
    start_velocity: tuple[float, float] = (0.5, 1.0)  # m/s, rad/s: std of an unknown velocity

    def __post_init__(self) -> None:
        if self.samples < 1 or self.samples % 2 == 0:
            expected = "an odd number: the mean, and pairs on either side of it, so that the map does not move"
            raise InputError("PrismConfig", "samples", f"{expected}; found {self.samples!r}")
