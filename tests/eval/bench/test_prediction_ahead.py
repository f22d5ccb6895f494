"""Test ``bench prediction LOG``: laws of both models, densities, the frame of the map, inputs, the whole command."""

import json
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.analytic_room import camera_pose
from tests.helpers.dynamics.logs import circling, write_euroc
from tests.helpers.localisation_room import CAMERA, ROOM
from vssm_gym.cli import main as main_module
from vssm_gym.data.sequences import SequenceWriter
from vssm_gym.errors import InputError
from vssm_gym.eval.bench.prediction.ahead import images, judged, states
from vssm_gym.eval.bench.prediction.ahead.euler import fit_euler, plain
from vssm_gym.eval.bench.prediction.ahead.judged import STEPS_AHEAD, Judged, read_judged
from vssm_gym.eval.bench.prediction.ahead.measure import measured_noise
from vssm_gym.eval.bench.prediction.ahead.picture import ring
from vssm_gym.eval.bench.prediction.ahead.rows import gains_of, rows_of
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.model.predictive import Envelope
from vssm_gym.model.transition import PLANAR, RIGID, GaussianBelief, Planar
from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.learned import LearnedTransition, Scales, untrained
from vssm_gym.model.transition.learned_file import TransitionFile, calibrated, load_transition, save_transition
from vssm_gym.model.transition.manifold import RigidState
from vssm_gym.slam.map_building import map_from_frames
from vssm_gym.training.dynamics import calibration
from vssm_gym.training.dynamics.calibration import with_gain
from vssm_gym.training.dynamics.windows import Windows

pytestmark = pytest.mark.usefixtures("quick_compilation")

DT, LENGTH = 0.2, STEPS_AHEAD[-1]
SMALL = CAMERA.resized(16, 12)


@pytest.fixture(autouse=True)
def few_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw fewer futures and images, from fewer starts."""
    monkeypatch.setattr(judged, "MOST_STARTS", 4)
    monkeypatch.setattr(states, "FUTURES", 96)
    monkeypatch.setattr(states, "IMAGE_SAMPLES", 8)
    monkeypatch.setattr(images, "PIXEL_STRIDE", 1)
    monkeypatch.setattr(calibration, "CALIBRATED_ON", 6)


def correcting_nothing(kind: str = "holonomic", stds: float = 0.01, size: int = 1) -> LearnedTransition:
    """Return a learned transition as a file holds it, whose network says nothing."""
    nominal = calibrated(kind)
    n, inputs = len(nominal.manifold.turns), body_axes(nominal.manifold).features + nominal.controls
    scales = Scales(jnp.zeros(inputs), jnp.ones(inputs), jnp.full(n, stds), jnp.asarray(DT))
    return untrained(jax.random.key(0), nominal, scales, size, width=2, depth=1)


@eqx.filter_jit
def drawn(moves: LearnedTransition, keys: Any, commands: Any) -> Any:
    """Return a path of each row of commands, from the origin."""
    start = moves.start(jnp.zeros((1, 3)))
    return jax.vmap(lambda key, u: moves.sample_paths(key, start, u, DT).body[0])(keys, commands)


def driven(count: int, seed: int, noise: float = 0.0) -> Windows:
    """Return windows of a robot that executes its commands exactly, or with noise of each step."""
    commands = jnp.asarray(np.random.default_rng(seed).uniform(-0.1, 0.1, (count, LENGTH, 3)), jnp.float32)
    moves = correcting_nothing(stds=max(noise, 1e-9))
    paths = drawn(moves, jax.random.split(jax.random.key(seed), count), commands)
    return Windows(jnp.concatenate([jnp.zeros((count, 1, 3)), paths], axis=1), commands)


def given(data: Windows, fitted: Windows) -> Judged:
    return Judged("a drive", "holonomic", DT, data, DT * LENGTH * np.arange(len(data)), fitted, "another drive", ())


@pytest.mark.slow
def test_integration_of_its_own_motion_has_no_error_and_its_envelopes_hold() -> None:
    one = given(driven(8, 1), driven(8, 2))
    euler = fit_euler(correcting_nothing(), one.fitted, DT, (0.0, 0.0))
    found = states.foresee(euler.transition, one, (0.0, 0.0), 0)
    assert found.position.max() < 1e-4
    assert found.rotation.max() < 1e-4
    assert found.held.all()
    assert [path.window for path in found.paths] == [2, 5]
    np.testing.assert_allclose(found.paths[0].truth[1:], found.paths[0].mean, atol=0.1)


@pytest.mark.slow
def test_the_noise_of_integration_is_that_of_the_motion_that_it_is_fitted_to() -> None:
    """White noise of 1 cm and 0.01 rad a step is found again, and no other size of it has a higher density."""
    one = given(driven(8, 3, 0.01), driven(8, 4, 0.01))
    euler = fit_euler(correcting_nothing(), one.fitted, DT, (0.0, 0.0))
    np.testing.assert_allclose(list(euler.stds.values()), 0.01, rtol=0.1)
    assert 0.8 < euler.gain < 1.3
    assert not euler.at_bound
    models = {gain: with_gain(euler.transition, gain) for gain in (1.0, 0.3, 3.0)}
    density = {gain: states.foresee(model, one, (0.0, 0.0), 0) for gain, model in models.items()}
    means = {gain: found.log_prob[:, [9, 29, 99]].mean() for gain, found in density.items()}
    assert means[1.0] > means[0.3] + 1.0
    assert means[1.0] > means[3.0] + 1.0
    assert 0.85 < density[1.0].held[:, 0].mean() <= 1.0
    assert density[0.3].held[:, 0].mean() < 0.6  # the gate opens for too little noise


@pytest.mark.slow
def test_a_transition_that_corrects_nothing_is_integration() -> None:
    """The same errors, and the same rows but for the draws."""
    one = given(driven(8, 5, 0.01), driven(8, 6, 0.01))
    learned = correcting_nothing(stds=0.01)
    euler = with_gain(fit_euler(learned, one.fitted, DT, (0.0, 0.0)).transition, 1.0)
    found = {name: states.foresee(t, one, (0.0, 0.0), 0) for name, t in (("euler", euler), ("learned", learned))}
    np.testing.assert_allclose(found["euler"].position, found["learned"].position, rtol=1e-5)
    np.testing.assert_allclose(found["euler"].rotation, found["learned"].rotation, rtol=1e-4)
    rows = [row for name, of in found.items() for row in rows_of(name, one, of, None)]
    for gain in gains_of(one, found, rows):
        assert gain["nearer"] == pytest.approx(1.0, rel=1e-5)
        assert abs(gain["pose_nats"]["mean"]) < 1.0
        assert gain["image_nats"] is None
    assert isinstance(plain(learned), Planar)
    assert rows[0]["pose_nats"]["low"] < rows[0]["pose_nats"]["mean"] < rows[0]["pose_nats"]["high"]


def test_the_density_of_a_pose_is_that_of_the_gaussian_in_the_tangent() -> None:
    """On the plane it is that of the belief; in space, metres beside milliradians do not spoil it."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    mean, covariance = jnp.array([[1.0, 2.0, 0.3]]), jnp.asarray(root @ root.T + np.eye(3), jnp.float32)
    state = jnp.array([[0.5, 2.5, 0.9]])
    found = states.pose_log_prob(PLANAR, Envelope(mean, covariance[None], jnp.ones(1)), state)
    expected = GaussianBelief(mean[0], covariance, PLANAR).log_prob(state[0])
    np.testing.assert_allclose(found[0], expected, rtol=1e-5)
    scale = np.array([30.0, 30.0, 10.0, 1e-3, 1e-3, 2e-3])
    mixed = np.eye(6) + 0.3 * rng.normal(size=(6, 6))
    wide = scale[:, None] * (mixed @ mixed.T) * scale
    at = RigidState(jnp.eye(4)[None], jnp.zeros((1, 6)))
    region = Envelope(at, jnp.asarray(wide, jnp.float32)[None], jnp.ones(1))
    found = states.pose_log_prob(RIGID, region, at)
    expected = -0.5 * np.linalg.slogdet(2.0 * np.pi * wide)[1]
    np.testing.assert_allclose(found[0], expected, atol=1e-3)


def test_a_ring_holds_its_share_of_places() -> None:
    places = np.random.default_rng(1).normal(size=(4000, 2)) @ np.array([[2.0, 0.0], [1.5, 0.3]])
    ellipse = ring(places, "#000000")
    angle = np.radians(ellipse.angle)
    along = (places - ellipse.center) @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    held = np.sum((2.0 * along / [ellipse.width, ellipse.height]) ** 2, axis=1) <= 1.0
    assert np.mean(held) == pytest.approx(0.95, abs=0.005)


def stored(folder: Path, kind: str = "holonomic", **trained: object) -> Path:
    path = folder / f"{kind}.npz"
    save_transition(path, correcting_nothing(kind), kind, {"measured_stds": [0.002, 0.002]} | trained)
    return path


def drive(folder: Path, frames: int, seed: int, shown: bool = True) -> Path:
    """Record a robot that turns and drives to and fro in the room of known depths; its camera is 1 m up."""
    rng = np.random.default_rng(seed)
    writer = SequenceWriter(folder, SMALL, camera_pose((0.0, 0.0, 1.0), 0.0))
    planar, rgbd = np.zeros(3), None
    for k in range(frames):
        command = np.array([0.04 * np.sin(k / 9.0 + seed), 0.0, 0.03 * np.cos(k / 7.0)])
        if k:
            heading = planar[2] + command[1] + 0.003 * rng.normal()
            planar = planar + np.array([command[2] * np.cos(heading), command[2] * np.sin(heading), command[0]])
        T = planar_to_matrix(planar) @ camera_pose((0.0, 0.0, 1.0), 0.0)
        if shown or rgbd is None:
            rgbd = ROOM.image(T, SMALL)
        rgb = np.rint(255.0 * np.asarray(rgbd.rgb)).astype(np.uint8)
        writer.append(DT * k, rgb, np.asarray(rgbd.depth), np.asarray(T, float), command)
    writer.close()
    return folder


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a drive ``log`` of 310 steps and a ``map.npz`` of the room."""
    folder = tmp_path_factory.mktemp("recorded")
    drive(folder / "log", 311, 1)
    poses = np.stack(
        [np.asarray(camera_pose((0.3 * np.cos(a), 0.3 * np.sin(a), 1.0), a)) for a in np.arange(0, 6.3, 0.35)]
    )
    seen = [ROOM.image(T, CAMERA) for T in poses]
    frames = [(np.rint(255.0 * np.asarray(i.rgb)).astype(np.uint8), np.asarray(i.depth)) for i in seen]
    map_from_frames(frames, poses, CAMERA, 0.1).save(folder / "map.npz")
    moved = poses.copy()
    moved[:, 0, 3] += 1.0
    map_from_frames(frames, moved, CAMERA, 0.1).save(folder / "moved.npz")
    return folder


def run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: object
) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["vssm-gym", "bench", *map(str, arguments)])
    code = main_module.main()
    captured = capsys.readouterr()
    return code, captured.out, captured.err


@pytest.mark.slow
def test_the_whole_command(recorded, monkeypatch, capsys, tmp_path) -> None:
    """A drive in a room of which there is a map: rows of both models with images, figure, page, and a new file."""
    asked = ("prediction", recorded / "log", "--transition", stored(tmp_path), "--map", recorded / "map.npz")
    code, printed, warned = run(monkeypatch, capsys, *asked, "--out", tmp_path / "out")
    assert code == 0, warned
    assert "learned" in printed
    result = json.loads((tmp_path / "out" / "prediction-log.json").read_text())
    names = [(row["model"], row["steps"]) for row in result["rows"]]
    assert names == [(model, steps) for model in ("euler", "learned") for steps in STEPS_AHEAD]
    for row in result["rows"]:
        assert row["position"] < 0.3
        assert row["image"]["images"] == row["windows"] == 4
        assert row["image"]["nats"]["mean"] > 0.0
        assert row["image"]["depth_crps"] < 0.3
    near, far = (row["image"]["nats"]["mean"] for row in (result["rows"][0], result["rows"][2]))
    assert near > far
    assert "first third" in result["setting"]["noise_of_euler_fitted_on"]
    assert (tmp_path / "out" / "prediction-log.svg").read_text().count("<svg") == 1
    assert "next 100 steps" in (tmp_path / "out" / "prediction-log.html").read_text()
    code, _, errors = run(monkeypatch, capsys, *asked, "--out", tmp_path / "out")
    assert code == 2
    assert "prediction-log" in errors


@pytest.mark.slow
def test_states_alone_of_a_flight(monkeypatch, capsys, tmp_path) -> None:
    """A flight with its noise fitted to another one: no images, a note, and what the learned one is named after."""
    for name, seconds in (("a", 25.0), ("b", 50.0)):
        (tmp_path / name).mkdir()
        write_euroc(tmp_path / name, circling(seconds))
    asked = ("prediction", tmp_path / "a", "--transition", stored(tmp_path, "imu", data=["a"]))
    code, _, warned = run(monkeypatch, capsys, *asked, "--fit", tmp_path / "b", "--out", tmp_path / "out")
    assert code == 0
    assert "states alone" in warned
    assert "has been seen" in warned
    result = json.loads((tmp_path / "out" / "prediction-a.json").read_text())
    assert result["setting"]["noise_of_euler_fitted_on"] == "b"
    assert all(row["image"] is None for row in result["rows"])


def test_inputs_are_refused_before_anything_runs(recorded, monkeypatch, capsys, tmp_path) -> None:
    """One line that names the file or option and what was expected."""
    transition, flight = stored(tmp_path), stored(tmp_path, "imu")
    (tmp_path / "flight").mkdir()
    euroc = write_euroc(tmp_path / "flight", circling(4.0))
    short = drive(tmp_path / "short", 60, 2, shown=False)
    log, with_it = recorded / "log", ("--transition", transition)
    moved = recorded / "moved.npz"
    for arguments, expected in (
        (("prediction", log), "--transition"),
        (("prediction", "--transition", transition), "LOG"),
        (("prediction", "--map", moved), "LOG"),
        (("slam", log, *with_it), "prediction LOG"),
        (("speed", log), "LOG"),
        (("slam",), "LOG"),
        (("prediction", tmp_path / "nowhere", *with_it), "there is none"),
        (("prediction", log, "--transition", tmp_path / "no.npz"), "no.npz"),
        (("prediction", log, "--transition", flight), "imu, 6 numbers"),
        (("prediction", euroc, *with_it), "holonomic, 3 numbers"),
        (("prediction", log, *with_it, "--fit", log), "other logs"),
        (("prediction", log, *with_it, "--fit", short), "at least 100 steps"),
        (("prediction", short, *with_it), "at least 300 steps"),
        (("prediction", log, *with_it, "--map", tmp_path / "no_map.npz"), "no_map.npz"),
        (("prediction", log, *with_it, "--map", moved), "world frame"),
    ):
        code, _, errors = run(monkeypatch, capsys, *arguments, "--out", tmp_path / "out")
        assert code == 2, arguments
        assert expected in errors
        assert errors.count("error:") == 1
    assert not list(tmp_path.glob("out/prediction*"))


def test_a_log_without_images_has_no_map(recorded, tmp_path) -> None:
    (tmp_path / "flight").mkdir()
    one = given(driven(8, 1), driven(8, 2))
    with pytest.raises(InputError, match="images"):
        images.load_sights(write_euroc(tmp_path / "flight", circling(4.0)), recorded / "map.npz", one)


def test_a_file_without_the_noise_of_its_poses_is_refused(tmp_path) -> None:
    for stds in (None, [0.1], [0.1, -1.0], ["a", 0.1], [0.1, float("inf")]):
        with pytest.raises(InputError, match="measured_stds"):
            measured_noise(TransitionFile(correcting_nothing(), "holonomic", {"measured_stds": stds}), tmp_path)


def test_what_is_judged_is_not_what_is_fitted_to(recorded, tmp_path) -> None:
    """Without another log the first third is fitted to, and no judged window begins in it."""
    one = read_judged(recorded / "log", load_transition(stored(tmp_path)))
    assert one.begins.min() > DT * 310 / 3
    assert len(one.data) == 4
    assert one.stretches[0] == 0
    last = np.asarray(one.fitted.states[:, -1, :2])
    first = np.asarray(one.data.states[:, 0, :2])
    assert np.linalg.norm(last[:, None] - first[None], axis=-1).min() > 0.0
