"""Test the prediction track: densities that do not integrate to one are found, and faults are worth knowing nothing."""

import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.eval.bench.prediction.contract import WorldModel
from vssm_gym.eval.bench.prediction.mixture import SampledPrediction
from vssm_gym.eval.benchmark.entries import find_entry
from vssm_gym.eval.benchmark.prediction.densities import MOST_MASS, masses
from vssm_gym.eval.benchmark.prediction.models import PREDICTORS
from vssm_gym.eval.benchmark.prediction.run import UNINFORMED, PredictionUnit, run_drive
from vssm_gym.files.shipped import MAPS, shipped
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
    """Multiply the densities of a prediction."""

    def __init__(self, of, depth=1.0, rgb=1.0):
        self.of, self.depth, self.rgb = of, depth, rgb

    def image_log_prob(self, image):
        found = self.of.image_log_prob(image)
        return ImageLogProb(found.depth + np.log(self.depth), found.rgb + np.where(image.hit, np.log(self.rgb), 0.0))


@pytest.mark.parametrize(
    "scales", [{}, {"depth": 0.004, "rgb": 0.01, "outlier": 0.01}, {"depth": 0.5, "rgb": 0.3, "outlier": 0.6}]
)
@pytest.mark.parametrize("right", [True, False])
def test_densities_of_the_emission_integrate_to_one(scales, right):
    """Predictions are of the image that was taken, or of others."""
    found = masses(prediction(images(0) if right else images(1, 2, 3), **scales), image(0), np.random.default_rng(0))
    np.testing.assert_allclose(found, 1.0, atol=0.25)


@pytest.mark.parametrize(("factors", "expected"), [((3.0, 1.0), (3.0, 1.0)), ((1.0, 2.5), (1.0, 2.5))])
def test_densities_that_are_none_are_found(factors, expected):
    found = masses(Changed(prediction(images(1, 2), rgb=0.2), *factors), image(0), np.random.default_rng(0))
    np.testing.assert_allclose(found, expected, rtol=0.2)
    assert max(found) > MOST_MASS


def test_the_models_of_the_package_fit_the_contract():
    assert all(isinstance(make(), WorldModel) for make in PREDICTORS.values())


BOASTING = """
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
    def predict(self, *given):
        return Boast(super().predict(*given))

class Blind(Persistence):
    name = "strangers_blind"
    def predict(self, *given):
        raise KeyError("no image")
"""


@pytest.mark.slow
def test_a_drive_is_scored_and_boasts_and_faults_are_worth_knowing_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "strangers_models.py").write_text(BOASTING)
    found = {}
    for reference in ("last_image", *(f"{tmp_path / 'strangers_models.py'}:{name}" for name in ("Boasting", "Blind"))):
        assert find_entry(reference).kind == "predictor"
        found[reference.rpartition(":")[2]] = run_drive(
            PredictionUnit("mine", reference, "oak", 0, 1, 0, shipped("oak", MAPS), 300.0)
        )
    assert found["last_image"]["fault"] is None
    assert UNINFORMED < found["last_image"]["score"] < 5.0
    assert found["last_image"]["p95"] > 0.0
    assert found["last_image"]["measured"].keys() == {"nats_1_s", "nats_3_s"}
    assert found["Boasting"]["fault"].startswith("its densities integrate to 1")  # e^5 = 148
    assert found["Boasting"]["score"] == UNINFORMED
    assert found["Blind"]["fault"] == "KeyError: 'no image'"
    assert found["Blind"]["score"] == UNINFORMED
