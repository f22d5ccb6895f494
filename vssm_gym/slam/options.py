"""Configure ``vssm-gym slam``: the options, and the filter, prior and trust in depth that follow from them."""

from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from vssm_gym.data.trajectories import from_tum
from vssm_gym.errors import InputError, one_of
from vssm_gym.geometry.camera import MAX_DEPTH, Camera
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.mapping.map_update import MapUpdateConfig
from vssm_gym.inference.prism.config import HAND, PrismConfig
from vssm_gym.inference.prism.filter import Prism
from vssm_gym.inference.smoothing.online import OnlineConfig, OnlineSmoother
from vssm_gym.inference.tracking.camera_filter import at_rest
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.map_tracker import MapTracker
from vssm_gym.inference.tracking.recovery import RecoveryConfig
from vssm_gym.inference.tracking.solvers import SOLVERS
from vssm_gym.maps.voxel_map import TRUNCATION, VoxelMap, read_metadata
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import RIGID, Transition
from vssm_gym.slam.learned_motion import load_flight_transition

START_STD = 0.3  # m, rad: std of the tracker's given start in a map
MAX_DENSE_CELLS = 30_000_000  # of about 25 bytes; larger cubes are stored block-sparse
MAX_SPARSE_CELLS = 1_000_000_000  # an unobserved cell of a sparse cube takes a tenth of a byte
# Pixels; the rotation search needs to shrink images to 20 pixels.
SMALLEST_IMAGE, LARGEST_IMAGE = (40, 30), (1280, 960)


@dataclass(frozen=True)
class DepthKind:
    """Configure the trust in the depth of one kind of sensor."""

    align: AlignConfig
    truncation: float = TRUNCATION  # voxels behind a surface that an image updates
    reference_limits: tuple[float, float] = (0.15, 0.15)  # m, rad: from a reference view, where a new one is made


_HAND_HELD = TrackingConfig()
DEPTHS = {
    # Structured light, active stereo near by
    "good": DepthKind(_HAND_HELD.align),
    # Noisy stereo at long range (PRISM): a wider truncation band, less weight on geometry, more on colour. Distant
    # surfaces change little when the camera moves half a metre: reference views serve longer, and with fewer of
    # them the camera images taken there drift less.
    "stereo": DepthKind(
        replace(_HAND_HELD.align, geo_sigma=0.02, geo_sigma_quadratic=0.005, rgb_weight=2.0, seen_weight=2.0),
        4.0,
        (0.5, 0.25),
    ),
}
ONLINE = OnlineConfig()
METHODS = ("prism", "smoother", "tracker")


@dataclass(frozen=True)
class SlamOptions:
    """Hold the options of ``vssm-gym slam``; an invalid value raises :class:`InputError`."""

    size: tuple[int, int] = (160, 120)  # width, height that images are resized to, pixels
    rate: float = 10.0  # frames a second at most
    voxel: float = 0.07  # m
    extent: float = 14.0  # m: edge of the cube that is mapped, around the first camera
    solver: str = "gauss_newton"  # of the pose, a key of SOLVERS
    samples: int = 1  # odd, of the pose in the map update; from 3 on the map's uncertainty reaches the pose too
    seed: int = 0
    render_width: int = 160  # pixels: images are tracked at about this width
    max_depth: float = MAX_DEPTH  # m; farther readings are left out
    depth: str = "good"  # a key of DEPTHS: what kind of sensor measured it
    imu: bool = False  # whether the sequence's IMU replaces constant velocity in the prior
    transition: Path | None = None  # file of a learned transition that does so, with the IMU's readings
    method: str = "prism"  # one of METHODS: filter, smooth without a filter, or track in ``map``
    map: Path | None = None  # of the tracker: the file of a learned map
    start: tuple[float, ...] | None = None  # of the tracker: about the first camera's pose, x y z qx qy qz qw
    refine: bool = False  # whether the smoother follows the filter
    learn_camera: bool = False  # whether the calibration of a colour camera apart is learned

    def __post_init__(self) -> None:
        if not all(low <= n <= high for low, n, high in zip(SMALLEST_IMAGE, self.size, LARGEST_IMAGE, strict=True)):
            low, high = ("x".join(map(str, size)) for size in (SMALLEST_IMAGE, LARGEST_IMAGE))
            raise InputError("slam", "size", f"width x height between {low} and {high}, not {self.size}")
        if not 0.0 < self.rate < np.inf:
            raise InputError("slam", "rate", f"frames a second, above 0, not {self.rate}")
        if not 0.0 < self.voxel <= 0.5:
            raise InputError("slam", "voxel", f"a cell size in (0, 0.5] m, not {self.voxel}")
        if not 10 * self.voxel <= self.extent < np.inf:
            raise InputError("slam", "extent", f"at least 10 cells of {self.voxel} m, not {self.extent} m")
        if self.cells > MAX_SPARSE_CELLS:
            raise InputError(
                "slam",
                "extent",
                f"at most {MAX_SPARSE_CELLS:,} cells, not {self.cells:,}: a smaller extent or larger voxels",
            )
        if self.method == "smoother" and (self.solver != "gauss_newton" or self.samples != 1):
            name = "samples" if self.samples != 1 else "solver"
            raise InputError("slam", name, "the default with method smoother: it is an option of prism and tracker")
        if self.solver not in SOLVERS:
            raise InputError("slam", "solver", one_of(SOLVERS, self.solver))
        if self.method not in METHODS:
            raise InputError("slam", "method", one_of(METHODS, self.method))
        if self.refine and self.method != "prism":
            whys = {
                "tracker": "the map is given, and poses do not change it",
                "smoother": "all poses are smoothed at the end in any case",
            }
            raise InputError("slam", "refine", f"False with method {self.method}: {whys[self.method]}")
        if self.learn_camera and self.method != "prism":
            raise InputError("slam", "learn-camera", f"False with method {self.method}: prism runs again and again")
        if (self.method == "tracker") != (self.map is not None):
            raise InputError("slam", "map", "a map file with method tracker, and none with another method")
        if self.map is not None:
            read_metadata(self.map)  # report an invalid map file before the sequence is read
        if self.imu and self.method == "tracker":
            expected = "False with method tracker: gravity is known in the first camera's frame, not in the map's"
            raise InputError("slam", "imu", expected)
        if self.transition is not None:
            if self.imu or self.method != "prism" or self.refine or self.learn_camera:
                expected = "none with imu, refine, learn-camera or another method: it is a prior of prism alone"
                raise InputError("slam", "transition", expected)
            load_flight_transition(self.transition)  # report an unsuitable file before the sequence is read
        if self.start is not None and self.method != "tracker":
            raise InputError("slam", "start", "a pose in a map, with method tracker: a new map begins at the camera")
        if self.start is not None and not (
            len(self.start) == 7 and np.isfinite(self.start).all() and 0.9 < np.linalg.norm(self.start[3:]) < 1.1
        ):
            raise InputError("slam", "start", f"x,y,z,qx,qy,qz,qw with a unit quaternion, not {self.start}")
        if not 1 <= self.samples <= 15 or self.samples % 2 == 0:
            raise InputError("slam", "samples", f"an odd number between 1 and 15, not {self.samples}")
        if not 0.5 <= self.max_depth <= 100.0:
            raise InputError("slam", "max-depth", f"metres between 0.5 and 100, not {self.max_depth}")
        if self.depth not in DEPTHS:
            raise InputError("slam", "depth", one_of(DEPTHS, self.depth))
        if not 0 <= self.seed < 2**32:
            raise InputError("slam", "seed", f"between 0 and 2^32 - 1, not {self.seed}")
        if not SMALLEST_IMAGE[0] <= self.render_width <= LARGEST_IMAGE[0]:
            raise InputError(
                "slam",
                "render-width",
                f"between {SMALLEST_IMAGE[0]} and {LARGEST_IMAGE[0]} pixels, not {self.render_width}",
            )

    @property
    def cells(self) -> int:
        """Return the number of cells of the mapped cube."""
        return round(self.extent / self.voxel) ** 3

    @property
    def T_level_world(self) -> Float[np.ndarray, "4 4"] | None:
        """Return the rotation of the world to z up, as in maps of ``map build``.

        None where only a camera defines the world.
        """
        return np.eye(4) if self.map is not None and "belief" not in read_metadata(self.map) else None

    @property
    def tracking(self) -> TrackingConfig:
        """Return the configuration of tracking."""
        return TrackingConfig(align=DEPTHS[self.depth].align, solver=self.solver)

    @property
    def update(self) -> MapUpdateConfig:
        """Return the configuration of the map's update."""
        return MapUpdateConfig(max_depth=self.max_depth, truncation=DEPTHS[self.depth].truncation)

    def filter(self, camera: Camera, transition: Transition = HAND) -> Prism | OnlineSmoother | MapTracker:
        """Return the filter of the method for images of a hand-held camera.

        Args:
            camera: of the images, at :attr:`size`.
            transition: how the camera moves, in its first frame.

        Returns:
            PRISM, the smoother that needs no filter, or the tracker in :attr:`map`.
        """
        if self.method == "tracker":
            return MapTracker(
                Rig.of(camera), transition, self.tracking, RecoveryConfig(), self.max_depth, self.render_width
            )
        if self.method == "smoother":
            smoothing = replace(ONLINE.smoothing, align=self.tracking.align)
            config = replace(
                ONLINE,
                smoothing=smoothing,
                tracking=self.tracking,
                update=self.update,
                track_width=self.render_width,
            )
            return OnlineSmoother(Rig.of(camera), transition, config)
        return self.prism(camera, transition)

    def prism(self, camera: Camera, transition: Transition = HAND) -> Prism:
        """Return PRISM for images of a hand-held camera.

        Args:
            camera: of the images, at :attr:`size`.
            transition: how the camera moves, in its first frame.

        Returns:
            PRISM with the options' sensor, size and solver.
        """
        kind = DEPTHS[self.depth]
        config = PrismConfig(
            tracking=self.tracking,
            update=self.update,
            samples=self.samples,
            track_width=self.render_width,
            reference_distance=kind.reference_limits[0],
            reference_angle=kind.reference_limits[1],
        )
        return Prism(Rig.of(camera), transition, config)

    def prior(self) -> Posterior:
        """Return the belief before the first image: its camera is the world's origin, or near ``start`` in the map."""
        velocity = self.tracking.start_velocity
        if self.map is not None:
            T = np.eye(4) if self.start is None else from_tum(np.array(self.start))
            return Posterior(
                at_rest(RIGID, jnp.asarray(T), START_STD**2 * jnp.eye(6), velocity), VoxelMap.load(self.map)
            )
        cube = VoxelMap.cube if self.cells <= MAX_DENSE_CELLS else VoxelMap.sparse_cube
        known = at_rest(RIGID, jnp.eye(4), 1e-8 * jnp.eye(6), velocity)
        return Posterior(known, cube((0.0, 0.0, 0.0), self.extent, self.voxel))
