"""Test the prediction track: peaks gain nothing, what is no distribution is found, faults are worth knowing nothing."""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.envs.sensors.rgbd_noise import PRESETS
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction.contract import WorldModel
from vssm_gym.eval.bench.prediction.mixture import SampledPrediction
from vssm_gym.eval.benchmark.entries import find_entry
from vssm_gym.eval.benchmark.prediction.levels import UNINFORMED, depth_edges, grey_edges, nats
from vssm_gym.eval.benchmark.prediction.models import PREDICTORS
from vssm_gym.eval.benchmark.prediction.run import PredictionUnit, run_drive
from vssm_gym.files.shipped import MAPS, shipped
from vssm_gym.geometry.camera import MAX_DEPTH
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales, ImageLogProb
from vssm_gym.model.transition import planar_belief

SHAPE = (20, 30)  # pixels
BELIEF = planar_belief(jnp.zeros(3), jnp.eye(3))


def image(seed):
    """Return an image with some pixels without a reading."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 6.0, SHAPE) * (rng.random(SHAPE) < 0.9)
    read = jnp.asarray(depth > 0.0)
    return RGBD(jnp.asarray(depth, jnp.float32), jnp.asarray(rng.random((*SHAPE, 3)), jnp.float32), read, read)


def images(*seeds):
    """Return images with a leading axis."""
    return jax.tree.map(lambda *a: jnp.stack(a), *map(image, seeds))


def prediction(images, **scales):
    """Return the emission about some images."""
    return SampledPrediction(images, replace(EmissionScales(), **scales), BELIEF.sample(jax.random.key(0), 100), BELIEF)


class Changed:
    """Change the functions of a prediction."""

    def __init__(self, of, **changed):
        self.of, self.changed = of, changed

    def __getattr__(self, name):
        return self.changed.get(name) or getattr(self.of, name)


class Uniform:
    """Know nothing."""

    def image_log_prob(self, image):
        return ImageLogProb(jnp.where(image.hit, jnp.log(0.5 / MAX_DEPTH), jnp.log(0.5)), 0.0 * image.depth)

    def depth_cdf(self, depth):
        return depth / MAX_DEPTH

    def rgb_cdf(self, rgb):
        return rgb


class Spikes(Uniform):
    """Have all mass within 1e-6 of the values that the camera can state, as much as who knows nothing."""

    step = PRESETS["kinect"].disparity_step / PRESETS["kinect"].baseline  # 1/m

    def depth_cdf(self, depth):
        counts = np.arange(int(1.0 / (self.step * MAX_DEPTH)), int(1.0 / (self.step * 0.05)) + 1)[::-1] + 0.5
        cells = np.array([0.0, *np.minimum(1.0 / (self.step * counts), MAX_DEPTH)])
        levels = np.array([0.025, *(1.0 / (self.step * (counts[:-1] - 0.5)))])
        d = np.asarray(depth, np.float64)
        k = np.clip(np.searchsorted(cells, d, side="right") - 1, 0, len(levels) - 1)
        part = np.clip((d - levels[k]) / 2e-6 + 0.5, 0.0, 1.0)
        return jnp.asarray((cells[k] + part * (cells[k + 1] - cells[k])) / MAX_DEPTH)

    def rgb_cdf(self, rgb):
        level = jnp.clip(jnp.round(rgb * 255.0), 0.0, 255.0)
        return (level + jnp.clip((rgb - level / 255.0) / 2e-6 + 0.5, 0.0, 1.0)) / 256.0


def measured_image(seed):
    """Return an image as a camera states it: grey levels, and steps of disparity."""
    exact, step = image(seed), Spikes.step
    depth = jnp.where(exact.hit, 1.0 / (step * jnp.round(1.0 / (step * jnp.where(exact.hit, exact.depth, 1.0)))), 0.0)
    return RGBD(depth, jnp.round(exact.rgb * 255.0) / 255.0, exact.hit, exact.known)


def test_who_knows_nothing_has_the_nats_that_a_failure_is_worth():
    found, read = nats(Uniform(), measured_image(0), "kinect"), np.asarray(image(0).hit).ravel()
    np.testing.assert_allclose(found[read], UNINFORMED, atol=2e-3)
    np.testing.assert_allclose(found[~read], np.log(0.5), atol=1e-6)


def test_peaks_at_what_a_camera_can_state_gain_nothing():
    seen = measured_image(0)
    peaks, uniform = (nats(model, seen, "kinect") for model in (Spikes(), Uniform()))
    assert abs(peaks.mean() - uniform.mean()) < 0.02
    assert (peaks - uniform).max() < 3.0 * np.log(2.0)  # black and white are half as wide as the other levels


@pytest.mark.parametrize("scales", [{}, {"depth": 0.05, "rgb": 0.1, "outlier": 0.01}])
def test_a_wide_density_is_the_mean_of_its_bins(scales):
    """The bins are then narrow beside it, so that it has the nats of its density, as `bench prediction` states them."""
    scales |= {"textured": 0.0, "rgb_outlier": 0.0, "guess_rgb_outlier": 0.0}
    model, seen = prediction(images(1), **scales), measured_image(1)
    log_p = model.image_log_prob(seen)
    read = np.asarray(seen.hit).ravel()
    expected = np.asarray(log_p.depth + log_p.rgb).ravel()
    found = nats(model, seen, "kinect")
    if scales.get("depth"):
        np.testing.assert_allclose(found[read].mean(), expected[read].mean(), atol=0.15)
        np.testing.assert_allclose(found[~read], expected[~read], atol=0.05)
    assert found.mean() <= expected.mean() + 0.05


def test_probabilities_of_all_bins_sum_to_one():
    for edges, end in ((depth_edges("kinect"), MAX_DEPTH), (grey_edges(), 1.0), (depth_edges("none"), MAX_DEPTH)):
        assert (edges[0], edges[-1]) == (0.0, end)
        assert np.diff(edges).min() > 0.0
    assert np.diff(depth_edges("kinect")).min() >= 0.0099
    levels = 1.0 / (Spikes.step * np.arange(45, 800))
    away = np.abs(levels[:, None] - depth_edges("kinect")[None, :]).min(axis=1)
    assert (away > 0.4 * Spikes.step * levels**2).all()  # no value of the camera is near an edge


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"rgb_cdf": lambda rgb: 3.0 * rgb}, r"rgb_cdf: expected a distribution function .* from 0 to 3"),
        ({"rgb_cdf": lambda rgb: rgb[..., :2]}, "rgb_cdf: expected a distribution function"),
        ({"depth_cdf": lambda depth: 1.0 - depth / MAX_DEPTH}, r"depth_cdf: .* falling by"),
        ({"depth_cdf": lambda depth: depth * jnp.nan}, r"depth_cdf: .* not finite"),
        (
            {"image_log_prob": lambda image: ImageLogProb(image.depth + 1.0, image.depth)},
            r"image_log_prob: expected a probability of no reading by pixel; found up to 2\.72",
        ),
    ],
)
def test_what_is_no_distribution_is_refused(changed, message):
    with pytest.raises(InputError, match=message):
        nats(Changed(Uniform(), **changed), measured_image(0), "kinect")


def test_a_value_that_was_held_to_be_impossible_costs_a_finite_number_of_nats():
    wrong = Changed(
        Uniform(), depth_cdf=lambda depth: (depth > 7.9).astype(jnp.float32), rgb_cdf=lambda rgb: rgb >= 1.0
    )
    assert np.isfinite(nats(wrong, measured_image(0), "kinect")).all()


def test_the_models_of_the_package_fit_the_contract():
    assert all(isinstance(make(), WorldModel) for make in PREDICTORS.values())


MODELS = """
from vssm_gym.eval.bench.prediction.models import Persistence
from vssm_gym.model.emission_density import ImageLogProb

class Boast:
    def __init__(self, of):
        self.of = of
    def __getattr__(self, name):
        return getattr(self.of, name)
    def image_log_prob(self, image):
        found = self.of.image_log_prob(image)
        return ImageLogProb(found.depth + 5.0, found.rgb)

class Boasting(Persistence):
    name = "strangers_boast"
    def predict(self, commands, *given):
        found = super().predict(commands, *given)
        return Boast(found) if len(commands) > 5 else found  # 3 s ahead alone

class Poor(Persistence):
    name = "strangers_poor"
    def predict(self, *given):
        found = super().predict(*given)
        return Wrong(found)

class Wrong(Boast):
    def image_log_prob(self, image):
        return self.of.image_log_prob(image)
    def depth_cdf(self, depth):
        return 1.0 * (depth > 7.9)
    def rgb_cdf(self, rgb):
        return 1.0 * (rgb > 0.999)

class Blind(Persistence):
    name = "strangers_blind"
    def predict(self, *given):
        raise KeyError("no image")
"""


@pytest.mark.slow
def test_a_drive_is_scored_and_boasts_and_faults_are_worth_knowing_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "strangers_models.py").write_text(MODELS)
    found = {}
    for reference in (
        "last_image",
        *(f"{tmp_path / 'strangers_models.py'}:{name}" for name in ("Boasting", "Poor", "Blind")),
    ):
        assert find_entry(reference).kind == "predictor"
        found[reference.rpartition(":")[2]] = run_drive(
            PredictionUnit("mine", reference, "oak", 0, 1, 0, shipped("oak", MAPS), 300.0)
        )
    assert found["last_image"]["fault"] is None
    assert UNINFORMED < found["last_image"]["score"] < 5.0
    assert found["last_image"]["p95"] > 0.0
    assert found["last_image"]["measured"].keys() == {"nats_1_s", "nats_3_s"}
    assert "a probability of no reading by pixel; found up to" in found["Boasting"]["fault"]
    assert found["Boasting"]["score"] == UNINFORMED
    assert found["Poor"]["fault"] is None
    assert found["Poor"]["score"] == UNINFORMED  # as bad as a failure, and not worse
    assert min(found["Poor"]["measured"].values()) < UNINFORMED
    assert found["Blind"]["fault"].startswith("KeyError: 'no image' (strangers_models.py, line ")
    assert found["Blind"]["score"] == UNINFORMED
    assert len({row["content"] for row in found.values()}) == 1
