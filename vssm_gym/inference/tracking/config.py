"""Configure how a camera is tracked: effort, gates, and what is modelled."""

from dataclasses import dataclass, field

from vssm_gym.errors import InputError
from vssm_gym.inference.alignment.adam import AdamConfig
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.alignment.rotation import RotationConfig
from vssm_gym.inference.alignment.surface_error import SurfaceErrorConfig
from vssm_gym.inference.tracking.confirmation import ConfirmationConfig
from vssm_gym.inference.tracking.process_noise import ProcessNoiseConfig
from vssm_gym.inference.tracking.solvers import SOLVERS


@dataclass(frozen=True)
class TrackingConfig:
    """Configure how the pose is estimated and when it is accepted. The defaults are those of a hand-held camera."""

    # Grows less with depth than one pixel's noise: far points are few but they constrain the rotation.
    align: AlignConfig = field(
        default_factory=lambda: AlignConfig(0.006, 0.001, edge=0.02, levels=(4, 2, 1), iterations=(6, 4, 4))
    )
    solver: str = "gauss_newton"  # a key of SOLVERS
    adam: AdamConfig = field(default_factory=AdamConfig)  # of the solver of that name
    rotation: RotationConfig | None = field(default_factory=RotationConfig)  # of the start; None: start as predicted
    heading_starts: tuple[float, ...] = ()  # stds: further starts are turned by them from the prediction
    search_reach: float = 0.075  # rad: no further starts where the angles' stds are smaller
    exposure: bool = True  # whether to estimate the camera's gain
    adaptation: ProcessNoiseConfig | None = field(
        default_factory=ProcessNoiseConfig
    )  # of the process noise; None: fixed
    surface_error: SurfaceErrorConfig | None = field(
        default_factory=SurfaceErrorConfig
    )  # of what poses are aligned to; None: the published Laplace covariance
    most_correlated: float = 1.0  # factor by which data weigh less against the prior, at most: their errors are alike
    smoothing: float = 0.8  # of the published Laplace covariance over time
    min_reading: float = 0.05  # share of the pixels that have depth; an image with fewer has no reading
    min_score: float = 0.6  # of :func:`alignment.score`
    max_photometric: float = 5.0  # mean |r_rgb| / sigma; cells of 7 cm blur the rendered image by that much
    repeated_displacement: float = 0.5  # pixels: a camera that is predicted to move by more repeats no depth image
    max_surprise: float = 12.0  # stds of the predicted pose: beyond them the camera jumped and the prior is wrong
    max_unconfirmed: float = 4.0  # stds of the predicted pose: a larger step must be confirmed
    confirmation: ConfirmationConfig | None = field(
        default_factory=ConfirmationConfig
    )  # by the colour; None: not needed
    start_velocity: tuple[float, float] = (0.5, 1.0)  # m/s, rad/s: std of an unknown velocity

    def __post_init__(self) -> None:
        if self.solver not in SOLVERS:
            raise InputError("TrackingConfig", "solver", f"one of {', '.join(SOLVERS)}; found {self.solver!r}")


# For a body whose commands are known. Three degrees of freedom and a known command suffice where six and constant
# velocity do not: in front of a bare wall, and in turns that start and end within a frame. A badly executed turn ends
# further from the predicted one than the search reaches from there.
COMMANDED = TrackingConfig(
    rotation=None,
    heading_starts=(-3.0, -2.0, -1.0, 1.0, 2.0, 3.0),
    exposure=False,
    adaptation=None,
    most_correlated=10.0,
    smoothing=0.0,
    min_reading=0.0,
    min_score=0.5,
    max_surprise=float("inf"),
    confirmation=None,
)
