"""Test the camera's noise against its stated law: statistics on planes, shadows by hand, all image sizes."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.envs.sensors import rgbd_noise_kernels as kernels
from vssm_gym.envs.sensors.rgbd_noise import PRESETS, NoisySensor, SensorNoise, _normal, sensor_noise
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera

CAMERA = Camera.from_hfov(160, 120, 1.2)
GREY = np.full((120, 160, 3), 128, np.uint8)


def plane(camera: Camera, normal: tuple[float, float, float], distance: float) -> np.ndarray:
    """Return the z-depth of the plane ``n . p = distance``; 0 where rays miss it."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    n = np.array(normal) / np.linalg.norm(normal)
    along = n[0] * (u - camera.cx) / camera.fx + n[1] * (v - camera.cy) / camera.fy + n[2]
    return np.where(along > 1e-6, distance / np.maximum(along, 1e-6), 0.0)


def sensor(noise: SensorNoise | str, camera: Camera = CAMERA, seed: int = 0) -> NoisySensor:
    return NoisySensor(sensor_noise(noise), camera, np.random.default_rng(seed))


def measured(noise: SensorNoise | str, depth: np.ndarray, camera: Camera = CAMERA, frames: int = 1) -> np.ndarray:
    """Measure depth images ``(frames, height, width)`` of the same view."""
    rgb = np.full((camera.height, camera.width, 3), 128, np.uint8)
    s = sensor(noise, camera)
    return np.stack([s(rgb, depth, 0.1)[1] for _ in range(frames)])


@given(st.integers(0, 1000))
def test_without_noise_the_image_is_exact(seed: int) -> None:
    """Images are equal byte for byte, holes included."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.05, 60.0, (12, 16)).astype(np.float32) * (rng.random((12, 16)) > 0.1)
    rgb = rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)
    seen, z = sensor("none", Camera.from_hfov(16, 12, 1.2))(rgb, depth, 0.1)
    np.testing.assert_array_equal(seen, rgb)
    np.testing.assert_array_equal(z, depth.astype(np.float32))


def test_the_same_stream_gives_the_same_bytes() -> None:
    depth = plane(CAMERA, (0.1, -0.2, 1.0), 2.0)
    np.testing.assert_array_equal(measured("kinect", depth, frames=2), measured("kinect", depth, frames=2))
    one, two = measured("kinect", depth, frames=2)
    assert (one != two).mean() > 0.3


@pytest.mark.parametrize("name", ["kinect", "stereo"])
@pytest.mark.parametrize("distance", [0.7, 1.5, 3.0, 5.0])
def test_depth_follows_its_law(name: str, distance: float) -> None:
    """Depth has no bias and the stated standard deviation, quantisation included, on a wall seen nearly face on.

    The wall is slightly slanted so that readings fall all over the quantisation steps.
    """
    noise = dataclasses.replace(PRESETS[name], grazing=0.0)  # the law of a surface seen face on
    depth = plane(CAMERA, (0.03, 0.02, 1.0), distance)
    z = measured(noise, depth, frames=30)
    read = z > 0.0
    error = ((z - depth) / noise.depth_std(depth))[read]
    assert read.mean() > 0.97
    assert abs(error.mean()) < 0.05
    # Rounding to a step nearly three standard deviations wide, as a Kinect's is near, is only nearly uniform.
    assert np.sqrt(np.mean(error**2)) == pytest.approx(1.0, abs=0.05)


def test_depth_comes_in_steps_of_disparity() -> None:
    """A Kinect's readings near 3 m lie 2.6 cm apart (Khoshelham and Elberink)."""
    values = np.unique(measured("kinect", plane(CAMERA, (0.0, 0.0, 1.0), 3.0), frames=3))
    values = values[(values > 2.9) & (values < 3.1)]
    assert len(values) > 3
    assert np.diff(values).min() == pytest.approx(0.026, abs=0.002)
    disparity = PRESETS["kinect"].baseline / values / PRESETS["kinect"].disparity_step
    np.testing.assert_allclose(disparity, np.rint(disparity), atol=1e-3)


def test_slanted_surfaces_are_noisier_and_grazing_ones_lost() -> None:
    noise = SensorNoise(floor=0.001, grazing=1e-4, max_incidence=np.radians(80.0))
    z60, z85 = (plane(CAMERA, (0.0, np.sin(a), np.cos(a)), 2.0 * np.cos(a)) for a in np.radians([60.0, 85.0]))
    middle = (slice(58, 62), slice(70, 90))
    errors = (measured(noise, z60, frames=200) - z60)[:, *middle]
    # Nguyen et al.: grazing / sqrt(z) theta^2 / (pi/2 - theta)^2 more; at 60 deg the last factor is 4.
    assert errors.std() == pytest.approx(0.001 + 1e-4 / np.sqrt(2.0) * 4.0, rel=0.05)
    assert (measured(noise, z85)[0][middle] == 0.0).all()


@given(st.floats(0.0, 1.3), st.floats(0.0, 6.28))
def test_incidence_on_a_plane_is_exact(tilt: float, around: float) -> None:
    normal = np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])
    depth = plane(CAMERA, tuple(normal), 2.0)
    v, u = np.mgrid[0:120, 0:160]
    x, y = (np.arange(160) - CAMERA.cx) / CAMERA.fx, (np.arange(120) - CAMERA.cy) / CAMERA.fy
    ray = np.stack([x[u], y[v], np.ones(u.shape)], -1)
    cosine = ray @ normal / np.linalg.norm(ray, axis=-1)
    hit = depth > 0.0
    inner = hit & np.roll(hit, 1, 0) & np.roll(hit, -1, 0) & np.roll(hit, 1, 1) & np.roll(hit, -1, 1)
    np.testing.assert_allclose(
        kernels.incidence(kernels.inverse_depth(depth), x, y, CAMERA.fx, CAMERA.fy)[inner], cosine[inner], atol=1e-6
    )


def test_the_shadow_of_a_post_has_the_width_of_triangulation() -> None:
    """A post at 1 m before a wall at 3 m: to its left ``b (1 - 1/3)`` of the wall, as a tangent, has no depth."""
    camera = Camera.from_hfov(1600, 12, 1.2)
    x = (np.arange(1600) - camera.cx) / camera.fx
    post = np.abs(x) < 0.1
    depth = np.tile(np.where(post, 1.0, 3.0), (12, 1))
    lost = measured(SensorNoise(baseline=0.075), depth, camera)[0, 5] == 0.0
    assert not lost[post].any()
    assert not lost[x > 0.1].any()
    assert lost.sum() / camera.fx == pytest.approx(0.075 * (1.0 - 1.0 / 3.0), abs=2.0 / camera.fx)
    np.testing.assert_allclose(x[lost].max(), -0.1, atol=1.0 / camera.fx)


def test_readings_near_an_edge_are_lost_and_slanted_floors_are_not() -> None:
    noise = SensorNoise(edge=0.03)
    step = np.where(np.arange(160) < 80, 1.0, 2.0) * np.ones((120, 1))
    lost = (measured(noise, step, frames=100) == 0.0).mean(axis=(0, 1))
    radius = round(0.03 * float(CAMERA.fx))
    assert radius > 1
    np.testing.assert_allclose(lost[80 - radius : 80 + radius], 0.5, atol=0.05)
    assert lost[: 80 - radius].max() == lost[80 + radius :].max() == 0.0
    floor = plane(CAMERA, (0.0, 1.0, 0.1), 1.4)
    horizon = int(np.argmax(floor[:, 0] > 0.0))  # an edge, of course
    assert (measured(noise, floor)[0, horizon + radius + 1 :] > 0.0).all()


@pytest.mark.parametrize(("grey", "distance"), [(20, 2.0), (12, 3.0), (128, 3.0), (40, 4.0), (0, 0.5)])
def test_dark_surfaces_return_nothing_from_afar(grey: int, distance: float) -> None:
    """The lost proportion is ``1.5 - s / min_signal``, clipped to [0, 1]; ``s = brightness cos / distance^2``."""
    noise = SensorNoise(min_signal=0.006)
    rgb = np.full((120, 160, 3), grey, np.uint8)
    s = sensor(noise)
    lost = np.mean([s(rgb, np.full((120, 160), distance), 0.1)[1][50:70, 70:90] == 0.0 for _ in range(30)])
    signal = grey / 255.0 / distance**2
    assert lost == pytest.approx(np.clip(1.5 - signal / 0.006, 0.0, 1.0), abs=0.025)


def test_dark_surfaces_aslant_return_less() -> None:
    """A grey floor seen from low down is lost beyond the same distance at every size of the image."""
    noise = SensorNoise(min_signal=0.004)
    edges = []
    for width in (80, 160, 320):
        camera = Camera.from_hfov(width, width * 3 // 4, 1.2)
        floor = plane(camera, (0.0, 1.0, 0.0), 0.4)
        rgb = np.full((*floor.shape, 3), 102, np.uint8)
        z = sensor(noise, camera)(rgb, floor, 0.1)[1]
        middle = np.abs(np.arange(width) - camera.cx) < 0.1 * width
        share = [
            (z[:, middle][(floor[:, middle] > a) & (floor[:, middle] < b)] > 0.0).mean()
            for a, b in ((2, 2.6), (4.2, 9))
        ]
        assert share[0] == 1.0 and share[1] == 0.0
        edges.append(z[:, middle].max())
    # s = 0.4 * 0.4 / r^3 falls to half of min_signal at 4.3 m.
    assert max(edges) <= 4.31 and max(edges) - min(edges) < 0.7


@given(st.integers(0, 1000))
def test_noise_from_sixteen_bits_is_normal(seed: int) -> None:
    n = _normal(np.random.default_rng(seed), (200_000,)).astype(float)
    assert n.mean() == pytest.approx(0.0, abs=0.012) and n.std() == pytest.approx(1.0, abs=0.008)
    assert np.mean(n**4) == pytest.approx(3.0, abs=0.1)
    assert np.mean(n > 2.0) == pytest.approx(0.02275, abs=0.002)


def test_range_ends() -> None:
    for distance, share in ((0.3, 0.0), (0.6, 1.0), (7.0, 1.0), (9.5, 0.0)):
        noise = dataclasses.replace(PRESETS["kinect"], min_signal=0.0)
        read = measured(noise, plane(CAMERA, (0.0, 0.0, 1.0), distance)) > 0.0
        assert read.mean() == pytest.approx(share, abs=0.01)


def test_colour_noise_grows_with_light_and_averages_over_wide_pixels() -> None:
    """Grey 0 has read noise alone, white both; a pixel n times as wide averages n^2 readings."""
    noise = SensorNoise(colour_read=6.0, colour_shot=8.0)
    fine = Camera(160, 120, 525.0, 525.0, 79.5, 59.5)
    for level in (60, 120, 180):
        seen = sensor(noise, fine)(np.full((120, 160, 3), level, np.uint8), np.ones((120, 160)), 0.1)[0].astype(float)
        assert seen.mean() == pytest.approx(level, abs=0.2)
        assert seen.std() == pytest.approx(np.sqrt(36.0 + 64.0 * level / 255.0), rel=0.02)
    coarse = Camera(160, 120, 175.0, 175.0, 79.5, 59.5)
    seen = sensor(noise, coarse)(GREY, np.ones((120, 160)), 0.1)[0]
    assert seen.std() == pytest.approx(np.sqrt(36.0 + 64.0 * 128 / 255.0) / 3.0, rel=0.02)


@pytest.mark.parametrize("width", [160, 320, 640])
def test_one_sensor_at_every_size(width: int) -> None:
    """Neither the proportion of lost readings nor the errors' statistics depend on the size of the image."""
    camera = Camera.from_hfov(width, width * 3 // 4, 1.2)
    x = (np.arange(width) - camera.cx) / camera.fx
    depth = np.tile(np.where((x > -0.2) & (x < 0.1), 1.0, 2.5), (camera.height, 1))
    z = measured("kinect", depth, camera, frames=4)
    assert (z == 0.0).mean() == pytest.approx(0.049, abs=0.012)
    wall = np.abs(z - 2.5) < 0.2
    assert (z - 2.5)[wall].std() == pytest.approx(PRESETS["kinect"].depth_std(2.5), rel=0.1)


def test_neighbouring_errors_are_alike_over_the_stated_angle() -> None:
    camera = Camera.from_hfov(640, 480, 1.2)
    noise = SensorNoise(floor=0.01, correlation=4.0 / float(camera.fx))
    errors = measured(noise, np.full((480, 640), 2.0), camera)[0] - 2.0
    assert errors.std() == pytest.approx(0.01, rel=0.03)
    for lag in (2, 4, 8):  # white noise through a Gaussian of standard deviation r: exp(-lag^2 / 4 r^2)
        correlation = np.mean(errors[:, lag:] * errors[:, :-lag]) / errors.var()
        assert correlation == pytest.approx(np.exp(-(lag**2) / 64.0), abs=0.05)


def test_exposure_wanders_slowly() -> None:
    """The gain's logarithm is stationary from the first image, with the correlation time ``exposure_time``."""
    noise = SensorNoise(exposure=0.1, exposure_time=2.0)
    tiny, depth = Camera.from_hfov(8, 8, 1.2), np.ones((8, 8))
    rgb = np.full((8, 8, 3), 100, np.uint8)
    gains = []
    for seed in range(400):
        s = sensor(noise, tiny, seed)
        images = [s(rgb, depth, dt)[0].mean() for dt in (0.1, 1.0, 1.0)]
        gains.append(np.log(np.array(images) / 100.0))
    first, _, third = np.array(gains).T
    assert first.std() == pytest.approx(0.1, rel=0.1)
    assert third.std() == pytest.approx(0.1, rel=0.1)
    assert np.corrcoef(first, third)[0, 1] == pytest.approx(np.exp(-1.0), abs=0.1)


@pytest.mark.parametrize(
    "change", [{"floor": -1.0}, {"growth": np.nan}, {"exposure_time": 0.0}, {"disparity_step": 0.1}, {"edge": np.inf}]
)
def test_impossible_noise_is_refused(change: dict) -> None:
    with pytest.raises(InputError):
        SensorNoise(**change)
    with pytest.raises(InputError, match="one of none, kinect, stereo"):
        sensor_noise("perfect")
