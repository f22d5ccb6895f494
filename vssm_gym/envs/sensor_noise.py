"""What a real RGB-D camera adds to an exact image: noise, quantisation, holes and exposure, the same at every size.

    z' = z + e,  e ~ N(0, sigma(z)^2),   sigma(z) = floor + growth max(0, z - start)^2        (Nguyen et al. 2012)

``sigma`` holds for a surface seen face on, quantisation included. Depth is measured by triangulation over a
``baseline`` b: its disparity ``b / z`` comes in multiples of ``disparity_step``, and what the projector (or the second
eye) cannot see has no depth. Lengths across the image are angles (tangents), not pixels, so that images of different
sizes show one sensor. A depth pixel is one reading however wide the pixel; a colour pixel averages all its light.

Left out: systematic distortion of depth, motion blur, rolling shutter, surfaces that are too dark or reflect.

Sources: Nguyen, Izadi, Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT
2012 (sigma, its growth with the incidence angle, jitter across the image); Khoshelham and Elberink, Sensors 2012 (b,
disparity steps); Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM", ICRA 2014 (order
of the effects).
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_dilation, gaussian_filter

from vssm_gym.camera import Camera
from vssm_gym.errors import InputError

PIXEL = 1.0 / 525.0  # tangent of the pixel that colour noise is stated for: a Kinect's at 640x480
JUMP = 0.05  # an edge is where inverse depth leaves the straight line of a plane by this share of itself


@dataclass(frozen=True)
class SensorNoise:
    """Parameters of the sensor; zero switches an effect off (``max_depth`` is then infinite)."""

    floor: float = 0.0  # m, depth standard deviation of a near surface seen face on
    growth: float = 0.0  # 1/m
    start: float = 0.0  # m
    grazing: float = 0.0  # m^1.5, of the part that grows with the incidence angle
    correlation: float = 0.0  # tangent over which neighbouring depth errors are alike
    jitter: float = 0.0  # tangent, standard deviation of where a reading was really taken
    baseline: float = 0.0  # m, from the camera to the projector on its right
    disparity_step: float = 0.0  # tangent
    edge: float = 0.0  # tangent from an edge within which half of the readings are lost
    dropout: float = 0.0  # share of readings lost anywhere
    min_depth: float = 0.0  # m; nearer surfaces have no reading
    max_depth: float = math.inf  # m; farther ones neither
    max_incidence: float = math.pi / 2  # rad between ray and normal; surfaces more aslant have no reading
    colour_read: float = 0.0  # grey levels, of a pixel of PIXEL, in the dark
    colour_shot: float = 0.0  # grey levels, at white: its variance is proportional to the light
    exposure: float = 0.0  # standard deviation of the logarithm of the gain
    exposure_time: float = 3.0  # s over which the gain changes

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not value >= 0.0 or (math.isinf(value) and field.name != "max_depth"):
                raise InputError("SensorNoise", field.name, f"a finite number >= 0, not {value!r}")
        if self.exposure_time == 0.0:
            raise InputError("SensorNoise", "exposure_time", "above 0 s")
        if self.disparity_step > 0.0 and self.baseline == 0.0:
            raise InputError("SensorNoise", "baseline", "above 0 m where disparity comes in steps")

    def depth_std(self, depth: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
        """``sigma(z)`` in m of depths in m, face on, quantisation included."""
        return self.floor + self.growth * np.maximum(depth - self.start, 0.0) ** 2


PRESETS = {
    "none": SensorNoise(),
    # Microsoft Kinect (PrimeSense structured light), the camera of TUM's RGB-D sequences.
    "kinect": SensorNoise(
        floor=0.0012,
        growth=0.0019,
        start=0.4,
        grazing=0.0001,
        correlation=3.0 * PIXEL,  # half the width of its 9x9 matching window, as a standard deviation's worth
        jitter=0.8 * PIXEL,
        baseline=0.075,
        disparity_step=0.125 / 580.0,  # an eighth of a pixel of the infrared camera: 2.6 cm at 3 m
        edge=4.5 * PIXEL,
        dropout=0.002,
        min_depth=0.4,
        max_depth=8.0,
        max_incidence=math.radians(82.0),
        colour_read=3.0,
        colour_shot=6.0,
        exposure=0.06,
    ),
    # Active stereo of a short baseline (RealSense D435 class): 2 % of the distance at 4 m, wider windows.
    "stereo": SensorNoise(
        floor=0.001,
        growth=0.005,
        grazing=0.0002,
        correlation=5.0 * PIXEL,
        jitter=1.0 * PIXEL,
        baseline=0.05,
        disparity_step=0.03125 / 420.0,  # 1/32 pixel at 848x480
        edge=6.0 * PIXEL,
        dropout=0.005,
        min_depth=0.25,
        max_depth=10.0,
        max_incidence=math.radians(80.0),
        colour_read=2.0,
        colour_shot=5.0,
        exposure=0.06,
    ),
}


def sensor_noise(spec: str | SensorNoise) -> SensorNoise:
    """A preset by name, or the noise itself; raises :class:`InputError` for an unknown name."""
    if isinstance(spec, SensorNoise):
        return spec
    if spec not in PRESETS:
        raise InputError("sensor_noise", "name", f"one of {', '.join(PRESETS)}, or a SensorNoise; found {spec!r}")
    return PRESETS[spec]


class NoisySensor:
    """A camera that measures exact images badly: one object is one sensor with its own random stream.

    Args:
        noise: what it does.
        camera: intrinsics of the images.
        rng: its stream; the same stream and the same images give the same bytes.
    """

    def __init__(self, noise: SensorNoise, camera: Camera, rng: np.random.Generator) -> None:
        self.noise = noise
        self._rng = rng
        self._log_gain = noise.exposure * float(rng.standard_normal())
        v, u = np.mgrid[0 : camera.height, 0 : camera.width].astype(np.float64)
        (self._fx, _, cx), (_, self._fy, cy), _ = camera.K
        self._x, self._y = (u - cx) / self._fx, (v - cy) / self._fy
        self._pixel = 1.0 / self._fx  # tangent

    def __call__(
        self, rgb: UInt8[np.ndarray, "height width 3"], depth: Float[np.ndarray, "height width"], dt: float
    ) -> tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]:
        """The image as measured, ``dt`` s after the one before: RGB uint8 and z-depth float32 in m, 0 = no reading."""
        return self._colour(rgb, dt), self._depth(np.asarray(depth, dtype=np.float64)).astype(np.float32)

    def _depth(self, z: np.ndarray) -> np.ndarray:
        noise, rng = self.noise, self._rng
        cosine = self._incidence(z)
        lost = (z <= 0.0) | self._shadow(z) | (cosine < math.cos(noise.max_incidence))
        lost |= rng.random(z.shape) < noise.dropout
        lost |= self._near_edge(z) & (rng.random(z.shape) < 0.5)
        z, cosine, lost = self._jittered(z, cosine, lost)
        angle = np.arccos(np.clip(cosine, 1e-3, 1.0))
        slanted = noise.grazing / np.sqrt(np.maximum(z, 0.1)) * (angle / (0.5 * np.pi - angle)) ** 2
        std = noise.depth_std(z) + slanted
        if noise.disparity_step > 0.0:
            # Rounding adds a uniform error of one step; what is left to the Gaussian makes the sum's variance std^2.
            step = z**2 * noise.disparity_step / noise.baseline
            std = np.sqrt(np.maximum(std**2 - step**2 / 12.0, 0.0))
        z = z + std * self._smooth_noise(z.shape)
        lost |= z <= 0.0
        if noise.disparity_step > 0.0:
            steps = np.rint(noise.baseline / (np.where(lost, 1.0, z) * noise.disparity_step))
            z = noise.baseline / (np.maximum(steps, 1.0) * noise.disparity_step)
        return np.where(lost | (z < noise.min_depth) | (z > noise.max_depth), 0.0, z)

    def _incidence(self, z: np.ndarray) -> np.ndarray:
        """Cosine between ray and normal. In the image of a plane ``n . p = c`` inverse depth is ``n . (x, y, 1) / c``:
        its gradient gives the normal without error. Of the two one-sided slopes the smaller one crosses no edge.
        """
        w = 1.0 / np.where(z > 0.0, z, 1e6)
        slopes = []
        for axis in (1, 0):
            step = np.diff(w, axis=axis)
            first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
            before, after = np.concatenate([first, step], axis), np.concatenate([step, last], axis)
            slopes.append(np.where(np.abs(before) < np.abs(after), before, after))
        w_x, w_y = slopes[0] * self._fx, slopes[1] * self._fy
        normal = np.sqrt(w_x**2 + w_y**2 + (w - self._x * w_x - self._y * w_y) ** 2)
        return w / (np.maximum(normal, 1e-12) * np.sqrt(1.0 + self._x**2 + self._y**2))

    def _shadow(self, z: np.ndarray) -> np.ndarray:
        """Where the projector sees something nearer: ``x - b / z`` is its own coordinate of a point of the row, and it
        falls from left to right only where a nearer surface to the right covers what lies to the left.
        """
        if self.noise.baseline == 0.0:
            return np.zeros(z.shape, dtype=bool)
        theirs = np.where(z > 0.0, self._x - self.noise.baseline / np.maximum(z, 1e-3), np.inf)
        least = np.minimum.accumulate(theirs[:, ::-1], axis=1)[:, ::-1]
        return theirs > least + 1e-9

    def _near_edge(self, z: np.ndarray) -> np.ndarray:
        """Pixels within the angle ``edge`` of a jump in depth."""
        if self.noise.edge == 0.0:
            return np.zeros(z.shape, dtype=bool)
        # Along a plane inverse depth is linear, however slanted: its second difference shows jumps alone, at the pixels
        # on both their sides.
        w = 1.0 / np.where(z > 0.0, z, 1e6)
        edge = np.zeros(z.shape, dtype=bool)
        edge[:, 1:-1] |= np.abs(w[:, 2:] - 2.0 * w[:, 1:-1] + w[:, :-2]) > JUMP * w[:, 1:-1]
        edge[1:-1] |= np.abs(w[2:] - 2.0 * w[1:-1] + w[:-2]) > JUMP * w[1:-1]
        radius = self.noise.edge / self._pixel
        if radius > 1.5:
            edge = binary_dilation(edge, iterations=round(radius) - 1)
        # Where a pixel is wider than the angle, its centre lies within the angle only this often.
        return edge & (self._rng.random(z.shape) < min(1.0, radius))

    def _jittered(self, *images: np.ndarray) -> list[np.ndarray]:
        """The images, each pixel taken from a place beside it."""
        height, width = images[0].shape
        shift = np.rint(self.noise.jitter / self._pixel * self._rng.standard_normal((2, height, width))).astype(int)
        rows = np.clip(np.arange(height)[:, None] + shift[0], 0, height - 1)
        columns = np.clip(np.arange(width) + shift[1], 0, width - 1)
        return [image[rows, columns] for image in images]

    def _smooth_noise(self, shape: tuple[int, ...]) -> np.ndarray:
        """Standard normal at every pixel, alike over ``correlation``."""
        white = self._rng.standard_normal(shape)
        radius = self.noise.correlation / self._pixel
        if radius < 0.3:  # the filter would leave it white
            return white
        impulse = np.zeros(8 * math.ceil(radius) + 1)
        impulse[len(impulse) // 2] = 1.0
        weight = float(
            np.sum(gaussian_filter(impulse, radius) ** 2)
        )  # a separable filter scales the variance by its square
        return gaussian_filter(white, radius, mode="wrap") / weight

    def _colour(self, rgb: np.ndarray, dt: float) -> np.ndarray:
        noise, rng = self.noise, self._rng
        if noise.exposure > 0.0:  # an Ornstein-Uhlenbeck process, exact for any dt
            keep = math.exp(-dt / noise.exposure_time)
            self._log_gain = keep * self._log_gain + noise.exposure * math.sqrt(1.0 - keep**2) * rng.standard_normal()
        light = np.minimum(rgb * math.exp(self._log_gain), 255.0)
        std = np.sqrt(noise.colour_read**2 + noise.colour_shot**2 * light / 255.0) * min(1.0, PIXEL / self._pixel)
        return np.rint(np.clip(light + std * rng.standard_normal(rgb.shape), 0.0, 255.0)).astype(np.uint8)
