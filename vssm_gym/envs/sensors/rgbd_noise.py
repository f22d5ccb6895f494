"""Simulate the errors of a real RGB-D camera: noise, quantisation, holes and exposure, the same at every image size.

    z' = z + e,  e ~ N(0, sigma(z)^2),   sigma(z) = floor + growth max(0, z - start)^2        (Nguyen et al. 2012)

``sigma`` holds for a surface seen face on, quantisation included. Depth is measured by triangulation over a
``baseline`` b: its disparity ``b / z`` comes in multiples of ``disparity_step``, and there is no depth where the
projector (or the second camera) is occluded. Lengths across the image are angles (tangents), not pixels, so that images
of different sizes show one sensor. A depth pixel is one reading however wide the pixel; a colour pixel averages all its
light.

The returned light is ``s = brightness cos(incidence) / distance^2``: surfaces that are dark, far or aslant have no
depth. Half of the readings are lost at ``min_signal``, all below half of it, none above one and a half times as much.
Brightness is that of the colour image, light included, since scenes do not store reflectance.

Systematic distortion of depth, motion blur, rolling shutter and reflecting surfaces are not modelled.

Sources: Nguyen, Izadi, Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction and tracking", 3DIMPVT
2012 (sigma, its growth with the incidence angle, jitter across the image); Khoshelham and Elberink, Sensors 2012 (b,
disparity steps); Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM", ICRA 2014 (order
of the effects). ``min_signal`` is Lambert's law with a threshold that we chose, not a measured one.
"""

import math
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, UInt8
from scipy.ndimage import binary_dilation
from scipy.special import ndtri

from vssm_gym.envs.presets import Presets
from vssm_gym.envs.sensors import rgbd_noise_kernels as kernels
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera

PIXEL = 1.0 / 525.0  # tangent of the pixel that colour noise is stated for: a Kinect's at 640x480


@dataclass(frozen=True)
class SensorNoise:
    """Define the errors of the sensor; zero switches an effect off (``max_depth`` is then infinite)."""

    floor: float = 0.0  # m, depth standard deviation of a near surface seen face on
    growth: float = 0.0  # 1/m
    start: float = 0.0  # m
    grazing: float = 0.0  # m^1.5, of the part that grows with the incidence angle
    correlation: float = 0.0  # tangent, correlation length of depth errors
    jitter: float = 0.0  # tangent, standard deviation of where a reading was really taken
    baseline: float = 0.0  # m, from the camera to the projector on its right
    disparity_step: float = 0.0  # tangent
    edge: float = 0.0  # tangent from an edge within which half of the readings are lost
    dropout: float = 0.0  # fraction of readings lost anywhere
    min_depth: float = 0.0  # m; nearer surfaces have no reading
    max_depth: float = math.inf  # m; farther ones neither
    max_incidence: float = math.pi / 2  # rad between ray and normal; surfaces more aslant have no reading
    min_signal: float = 0.0  # 1/m^2, of brightness cos(incidence) / distance^2 where half of the readings are lost
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
        """Return ``sigma(z)`` in m of depths in m, face on, quantisation included."""
        return self.floor + self.growth * np.maximum(depth - self.start, 0.0) ** 2


PRESETS = {
    "none": SensorNoise(),
    # Microsoft Kinect (PrimeSense structured light), the camera of TUM's RGB-D sequences.
    "kinect": SensorNoise(
        floor=0.0012,
        growth=0.0019,
        start=0.4,
        grazing=0.0001,
        correlation=3.0 * PIXEL,  # half the width of its 9x9 matching window, as a standard deviation
        jitter=0.8 * PIXEL,
        baseline=0.075,
        disparity_step=0.125 / 580.0,  # an eighth of a pixel of the infrared camera: 2.6 cm at 3 m
        edge=4.5 * PIXEL,
        dropout=0.002,
        min_depth=0.4,
        max_depth=8.0,
        max_incidence=math.radians(82.0),
        min_signal=0.006,  # black (0.04) face on to 2.6 m; a grey floor (0.4) seen from 0.4 m above it to 3.0 m
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
        min_signal=0.001,  # it matches in ambient light: black, face on, to 6.3 m
        colour_read=2.0,
        colour_shot=5.0,
        exposure=0.06,
    ),
}


sensor_noise = Presets("environment", "sensor_noise", SensorNoise, PRESETS)


class NoisySensor:
    """Add the errors to exact images; one object is one camera with its own random stream.

    Args:
        noise: its errors.
        camera: intrinsics of the images.
        rng: its stream; the same stream and the same images give the same bytes.
    """

    def __init__(self, noise: SensorNoise, camera: Camera, rng: np.random.Generator) -> None:
        self.noise = noise
        self._rng = rng
        self._log_gain = noise.exposure * float(rng.standard_normal())
        self.set_camera(camera)

    def set_camera(self, camera: Camera) -> None:
        """Measure images of these intrinsics from now on; exposure and stream continue."""
        (self._fx, _, cx), (_, self._fy, cy), _ = camera.K
        self._x, self._y = (np.arange(camera.width) - cx) / self._fx, (np.arange(camera.height) - cy) / self._fy
        self._pixel = 1.0 / self._fx  # tangent
        self._taps = _smoothing(self.noise.correlation / self._pixel)

    def __call__(
        self, rgb: UInt8[np.ndarray, "height width 3"], depth: Float[np.ndarray, "height width"], dt: float
    ) -> tuple[UInt8[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]:
        """Return the measured image, ``dt`` s after the one before.

        RGB uint8 and z-depth float32 in m, 0 = no reading.
        """
        if self.noise == PRESETS["none"]:
            return rgb.copy(), np.array(depth, dtype=np.float32)
        return self._colour(rgb, dt), self._depth(np.asarray(depth), rgb)

    def _depth(self, z: np.ndarray, rgb: np.ndarray) -> np.ndarray:
        noise, rng = self.noise, self._rng
        w = kernels.inverse_depth(z)
        cosine = kernels.incidence(w, self._x, self._y, self._fx, self._fy)
        chance = rng.random(z.shape, dtype=np.float32)
        edge, edge_share = self._near_edge(w)
        covered = kernels.shadow(w, self._x, noise.baseline)
        min_cosine = math.cos(noise.max_incidence)
        lost = kernels.losses(
            *(z, w, cosine, rgb, self._x, self._y, edge, covered, chance),
            *(min_cosine, noise.dropout, edge_share, noise.min_signal),
        )
        reach = len(self._taps) // 2
        normal = _normal(rng, (z.shape[0] + 2 * reach, z.shape[1] + 2 * reach))
        if reach:
            normal = kernels.smooth(normal, self._taps)
        step_1m = noise.disparity_step / noise.baseline if noise.disparity_step > 0.0 else 0.0
        return kernels.measure(
            *(z, cosine, lost, self._shift(z.shape), normal),
            *(noise.floor, noise.growth, noise.start, noise.grazing, step_1m, noise.min_depth, noise.max_depth),
        )

    def _near_edge(self, w: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the pixels within the angle ``edge`` of a jump in depth, and the fraction of their lost readings."""
        edge, radius = kernels.edges(w), self.noise.edge / self._pixel
        if radius > 1.5:
            edge = binary_dilation(edge, iterations=round(radius) - 1)
        # Where a pixel is wider than the angle, its centre lies within the angle only this often.
        return edge, 0.5 * min(1.0, radius)

    def _shift(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return the pixels down and right to where each reading is taken, ``(2, height, width)``.

        Empty if there is no jitter.
        """
        std = self.noise.jitter / self._pixel
        if std < 0.125:  # half a pixel is four standard deviations
            return np.zeros((0, 0, 0), dtype=np.int32)
        return np.rint(std * _normal(self._rng, (2, *shape))).astype(np.int32)

    def _colour(self, rgb: np.ndarray, dt: float) -> np.ndarray:
        noise, rng = self.noise, self._rng
        if noise.exposure > 0.0:  # an Ornstein-Uhlenbeck process, exact for any dt
            keep = math.exp(-dt / noise.exposure_time)
            self._log_gain = keep * self._log_gain + noise.exposure * math.sqrt(1.0 - keep**2) * rng.standard_normal()
        light = np.minimum(np.arange(256) * math.exp(self._log_gain), 255.0)
        std = np.sqrt(noise.colour_read**2 + noise.colour_shot**2 * light / 255.0) * min(1.0, PIXEL / self._pixel)
        return kernels.colour(rgb, light, std, _normal(rng, rgb.shape))


# Quantiles of the standard normal in the middle of 65536 equal shares; scaled, because a share has a width of its own.
_QUANTILES = ndtri((np.arange(65536) + 0.5) / 65536.0)
_QUANTILES = (_QUANTILES / _QUANTILES.std()).astype(np.float32)


def _normal(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Draw standard normal numbers, float32, of 16 random bits each (none beyond 4.4).

    Six times faster than exact ones.
    """
    return _QUANTILES[rng.integers(0, 65536, shape, dtype=np.uint16)]


def _smoothing(radius: float) -> np.ndarray:
    """Return the taps of a Gaussian filter of ``radius`` pixels, float32, scaled to preserve the variance of images."""
    if radius < 0.3:  # it would leave white noise white
        return np.ones(1, dtype=np.float32)
    offsets = np.arange(-math.ceil(4.0 * radius), math.ceil(4.0 * radius) + 1)
    taps = np.exp(-0.5 * (offsets / radius) ** 2)
    return (taps / np.sqrt(np.sum(taps**2))).astype(np.float32)
