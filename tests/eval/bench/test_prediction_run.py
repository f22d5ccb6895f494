"""Test ``bench prediction``: a model of the test's own is scored, pixels are those of the camera, the whole command."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import camera_pose
from tests.helpers.localisation_room import CAMERA, ROOM
from vssm_gym.agents.base import AgentContext
from vssm_gym.cli.bench import bench
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction import fit, models, run
from vssm_gym.eval.bench.prediction.contract import WorldModel
from vssm_gym.eval.bench.prediction.mixture import SampledPrediction
from vssm_gym.eval.bench.prediction.models import Persistence, VssmLm, shown
from vssm_gym.eval.bench.prediction.page import HEADER, answer, line_of
from vssm_gym.eval.bench.prediction.rows import row_of
from vssm_gym.eval.studies.calibration import drives
from vssm_gym.eval.studies.calibration.replay import Drive
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.transition import MotionNoise, Planar, planar_belief

FRAMES, DT = 40, 0.2
STEP = np.array([0.0, 0.0, 0.03])  # straight on, 0.15 m/s


def images() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return what a camera sees that moves through the room along x."""
    seen = [ROOM.image(camera_pose((-1.0 + 0.03 * frame, 0.0, 1.0), 0.0), CAMERA) for frame in range(FRAMES)]
    return [(np.rint(255 * np.asarray(i.rgb)).astype(np.uint8), np.asarray(i.depth)) for i in seen]


@pytest.fixture(scope="module")
def given() -> run.MappedDrive:
    planar = np.column_stack([-1.0 + 0.03 * np.arange(FRAMES), np.zeros(FRAMES), np.zeros(FRAMES)])
    context = AgentContext(
        K=CAMERA.K,
        camera=(CAMERA.width, CAMERA.height),
        T_body_cam=camera_pose((0.0, 0.0, 1.0), 0.0),
        limits=np.array([0.5, 0.5, 0.2]),
        dt=DT,
        map=None,
        start_pose=planar[0],
        body_length=0.3,
        success_radius=0.2,
        noise=(0.05, 0.02),
        transition=Planar(MotionNoise(0.05, 0.02)),
    )
    commands = np.tile(STEP, (FRAMES - 1, 1))
    return run.MappedDrive("room", Drive(context, tuple(images()), commands, planar, np.zeros(FRAMES - 1, bool)))


class DeadReckoning:
    """Predict the true image of the room from where the commands lead: a model that shares no code with the others."""

    name = "dead reckoning in the true room"

    def begin(self, context: AgentContext, image: RGBD) -> None:
        self.planar, self.seen = np.array(context.start_pose), 1

    def observe(self, command: np.ndarray, image: RGBD) -> None:
        self.planar = self.planar + np.array([command[2], 0.0, 0.0])
        self.seen += 1

    def predict(self, commands, camera, key) -> SampledPrediction:
        ahead = self.planar + np.array([commands[:, 2].sum(), 0.0, 0.0])
        image = ROOM.image(camera_pose((*ahead[:2], 1.0), 0.0), camera)
        belief = planar_belief(jnp.asarray(ahead, jnp.float32), jnp.eye(3) * 1e-4)
        one = jax.tree.map(lambda a: a[None], image)
        return SampledPrediction(one, EmissionScales(miss=1e-3), belief.sample(key, 100), belief)


def test_a_model_of_another_kind_is_scored(given) -> None:
    """It is right at every time, and sees no image of the future."""
    model, counted = DeadReckoning(), []
    assert isinstance(model, WorldModel)
    found = run.scored(model, given, 0, lambda: counted.append(model.seen))
    starts = run.times(given.drive)
    assert starts == [10, 20]
    assert counted == [11, 11, 21, 21]  # images that the model had seen: none of the future
    assert list(found) == [1.0, 3.0]
    for scores in found.values():
        for one in scores:
            assert one.depth_nats.shape == (16 * 12,)
            assert np.median(one.depth_crps) < 0.01
            assert one.location_crps < 0.01
            assert one.depth_nats.mean() > 3.0
    row = row_of(model.name, 3.0, [found[3.0]])
    assert len(line_of(row)) == len(HEADER)
    assert row["nats"]["low"] is None  # one drive has no interval
    assert "dead reckoning in the true room is best" in answer({"rows": [row]})


def test_the_fitted_motion_is_that_of_the_drive(given) -> None:
    np.testing.assert_allclose(fit._motions(given, 1.0), np.tile([0.15, 0.0, 0.0], (2, 1)), atol=1e-5)


def test_the_scored_pixels_are_those_of_the_thinned_camera() -> None:
    """The analytic image of the thinned camera is every fourth pixel of the full one."""
    T = camera_pose((-1.0, 0.2, 1.0), 0.4)
    full, few = ROOM.image(T, CAMERA), run.every_nth(CAMERA, 4)
    assert (few.width, few.height) == (16, 12)
    direct, thinned = ROOM.image(T, few), run.thinned(full, 4)
    np.testing.assert_allclose(np.asarray(direct.depth), np.asarray(thinned.depth), atol=1e-4)
    for of_last, expected in zip(jax.tree.leaves(shown(full, CAMERA, few)), jax.tree.leaves(thinned), strict=True):
        np.testing.assert_array_equal(np.asarray(of_last[0]), np.asarray(expected))


def test_every_listed_model_meets_the_contract_and_has_its_own_name() -> None:
    listed = models.models()
    assert all(isinstance(model, WorldModel) for model in listed)
    assert len({model.name for model in listed}) == len(listed) >= 4


def test_a_model_of_a_map_asks_for_one(given) -> None:
    for model in (VssmLm(), Persistence()):
        with pytest.raises(InputError, match="a learned map"):
            model.begin(given.drive.context, given.image(0))


@pytest.mark.slow
def test_the_whole_command(monkeypatch, tmp_path, capsys) -> None:
    """One short drive in a coarse map: rows of every model, the fit, the page, and what is refused a second time."""
    monkeypatch.setattr(drives, "DRIVE_FRAMES", 32)
    monkeypatch.setattr(run, "MAP_VOXEL", 0.1)
    monkeypatch.setattr(models, "IMAGE_SAMPLES", 8)
    bench("prediction", out=tmp_path, trials=1)
    result = json.loads((tmp_path / "prediction-train.json").read_text())
    names = [model.name for model in models.models()]
    assert [(row["model"], row["seconds"]) for row in result["rows"]] == [(n, s) for n in names for s in (1.0, 3.0)]
    best, *_, persisting, _ = result["rows"]
    assert best["nats"]["mean"] > persisting["nats"]["mean"]
    assert 0.001 <= result["fitted"]["emission"]["depth"] < 0.1
    assert result["setting"]["scenes"] == ["fern", "reed"]
    page = (tmp_path / "prediction-train.html").read_text()
    assert "1 s ahead" in page
    assert "95 % band" in page
    assert (tmp_path / "prediction-train.svg").read_text().count("<svg") == 1
    assert "bench prediction: train" in capsys.readouterr().out
    with pytest.raises(InputError, match="prediction-train"):
        bench("prediction", out=tmp_path, trials=1)
