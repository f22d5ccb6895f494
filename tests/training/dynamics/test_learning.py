"""Test that known drag and bias are recovered, that a learned transition beats integration, and the command."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.data.test_dynamics_logs import write_recording
from tests.helpers.dynamics.logs import circling, dragged, lagging, write_euroc
from tests.helpers.dynamics.transitions import noisy_transition
from vssm_gym.data.dynamics.log import DynamicsLog, cut
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.model.transition import PLANAR, RIGID, Bicycle, GaussianBelief, Imu
from vssm_gym.model.transition.learned_file import NOMINALS, load_transition
from vssm_gym.training.dynamics import calibration as calibration_module
from vssm_gym.training.dynamics import learn as learn_module
from vssm_gym.training.dynamics.baselines import fit_bias, fit_parametric
from vssm_gym.training.dynamics.calibration import GAINS, HELD_SHARE, calibrate, calibrate_together, with_gain
from vssm_gym.training.dynamics.evaluation import WINDOWS_AT_ONCE, coverage, path_errors, step_likelihood
from vssm_gym.training.dynamics.fit import FitConfig, fit
from vssm_gym.training.dynamics.learn import GAP, LearnConfig, folded, learn
from vssm_gym.training.dynamics.windows import Windows, windows

pytestmark = pytest.mark.usefixtures("quick_compilation")  # 150 s of a core instead of 320

DT = 0.1  # s
BIAS = np.array([0.1, -0.15, 0.05, 0.0, 0.0, 0.03])  # m/s^2, rad/s


@pytest.fixture(scope="module")
def parts():
    """Return windows of 20 steps of two flights of the same body."""
    return [windows([cut(dragged(40.0, seed, BIAS), DT)], RIGID, 20, 2) for seed in (1, 2)]


@pytest.fixture(autouse=True)
def few_windows(monkeypatch):
    """Sample fewer futures: each window takes a tenth of a second, and most of a test's time otherwise."""
    monkeypatch.setattr(calibration_module, "CALIBRATED_ON", 12)
    monkeypatch.setattr(learn_module, "COVERED_WINDOWS", 8)


@pytest.mark.slow
def test_drag_and_bias_are_recovered(parts):
    constants = fit_parametric(Imu(), parts[0], DT).constants
    np.testing.assert_allclose(constants.accel_bias[:2], BIAS[:2], atol=0.05)
    np.testing.assert_allclose(constants.gyro_bias[2], BIAS[5], atol=0.01)
    np.testing.assert_allclose(constants.drag[:2], 0.3, atol=0.06)
    fitted = [f(Imu(), parts[0], DT) for f in (fit_bias, fit_parametric)]
    errors = [path_errors(model, parts[1], DT).position[-1] for model in (Imu(), *fitted)]
    assert errors[2] < 0.3 * errors[1] < 0.3 * errors[0]


@pytest.mark.slow
def test_a_learned_transition_beats_integration_on_another_flight(parts):
    """Its envelopes hold most of what happens; with hardly any noise they do not."""
    folds = folded([cut(dragged(40.0, 1, BIAS), DT)], RIGID, 20, 2)
    fitted = fit(Imu(), folds, DT, FitConfig(updates=300, batch=16, members=2))
    assert not fitted.interrupted
    assert fitted.transition.members == 2
    errors = [path_errors(model, parts[1], DT).position[-1] for model in (Imu(), fitted.transition)]
    assert errors[1] < 0.6 * errors[0]  # so few updates give 0.2 to 0.5, by how the compiler rounds
    held = coverage(fitted.transition, parts[1].take(slice(0, None, 10)), DT, fitted.noise)
    assert 0.8 < held.mean() <= 1.0
    surer = with_gain(fitted.transition, 0.01)
    assert coverage(surer, parts[1].take(slice(0, None, 10)), DT).mean() < 0.5
    assert np.isfinite(step_likelihood(fitted.transition, parts[0], parts[1], DT, fitted.noise))


@pytest.mark.slow
def test_the_spread_for_biases_is_kept():
    """Networks that have learned nothing know seen windows no better than others: together they are as sure as one."""
    folds = folded([cut(dragged(40.0, 1, BIAS), DT)], RIGID, 20, 2)
    nominal = fit_parametric(Imu(), folds.data, DT)
    fitted = fit(nominal, folds, DT, FitConfig(updates=1, batch=16, members=2))
    assert fitted.gain > 2.0  # for biases as another flight may have
    assert fitted.factor > 0.7


def test_a_robot_that_slips_is_learned_better_than_its_commands_say():
    """Gains of a drive are recovered from its commands and poses."""
    rng, pose, poses = np.random.default_rng(0), np.zeros(3), [np.zeros(3)]
    commands = np.stack([rng.uniform(0.2, 1.0, 200), rng.uniform(-0.3, 0.3, 200)], axis=1)
    for u in commands:
        executed = jnp.asarray(u * [0.7, 1.1], jnp.float32)
        pose = np.asarray(Bicycle().mean(jnp.asarray(pose, jnp.float32), executed, DT))
        poses.append(pose)
    times = DT * np.arange(201)
    log = DynamicsLog("a drive", "car", times, planar_to_matrix(np.array(poses, float)), times[1:], commands)
    data = windows([cut(log)], PLANAR, 20, 5)
    found = fit_parametric(Bicycle(), data, DT)
    np.testing.assert_allclose(np.diag(found.gain), [0.7, 1.1], atol=0.02)
    assert path_errors(found, data, DT).position[-1] < 0.02 * path_errors(Bicycle(), data, DT).position[-1]


def test_errors_of_all_windows_are_those_of_their_parts():
    """Mean squares add up over parts of any length, more or fewer windows than are computed at once."""
    steps = cut(lagging(30.0, 2))
    data = windows([steps], PLANAR, 10)
    model, n = NOMINALS["holonomic"](), len(data)
    assert WINDOWS_AT_ONCE < n < 3 * WINDOWS_AT_ONCE
    parts = [data.take(slice(0, 30)), data.take(slice(30, None))]
    squares = [len(part) * path_errors(model, part, steps.dt).position ** 2 for part in parts]
    np.testing.assert_allclose(n * path_errors(model, data, steps.dt).position ** 2, sum(squares), rtol=1e-5)
    densities = [len(part) * step_likelihood(model, parts[0], part, steps.dt) for part in parts]
    assert n * step_likelihood(model, parts[0], data, steps.dt) == pytest.approx(sum(densities), rel=1e-5)


@pytest.mark.slow
def test_a_robot_with_slip_and_lag_is_predicted_five_seconds_ahead():
    """A drive of two minutes: its next five seconds are predicted better than by the commands.

    How far the robot still is from its last commands is not known at the start of a window, which bounds the gain.
    """
    steps, nominal = cut(lagging(150.0, 3)), NOMINALS["holonomic"]()
    folds = folded([steps.part(0, 600)], nominal.manifold, 25, 2)
    after = windows([steps.part(600, 750)], nominal.manifold, 25)
    start = fit_bias(nominal, folds.data, steps.dt)
    fitted = fit(start, folds, steps.dt, FitConfig(updates=500, batch=16, members=2))
    errors = [path_errors(model, after, steps.dt).position[-1] for model in (nominal, start, fitted.transition)]
    assert errors[2] < 0.6 * errors[0]


def test_no_network_has_seen_a_step_that_it_is_judged_on():
    """Every window is held out from one network at most, and all of them are used."""
    steps = [cut(lagging(30.0, seed)) for seed in (1, 2)]
    folds = folded(steps, PLANAR, 10, 3)
    first = np.concatenate([np.arange(len(s) - 9) + 1000 * k for k, s in enumerate(steps)])
    for seen, held in zip(folds.seen, folds.held, strict=True):
        apart = np.abs(first[seen][:, None] - first[held])
        assert apart.min() >= 10 + GAP
        assert {0, 1} == set(first[held] // 1000)
    held = np.concatenate(folds.held)
    assert len(np.unique(held)) == len(held)
    assert set(np.concatenate(folds.seen)) | set(held) <= set(range(len(folds.data)))


def test_a_window_has_one_bias_and_windows_have_different_ones():
    data = windows([cut(lagging(12.0, 1))], PLANAR, 10)
    biased = data.with_biases(jax.random.key(0), jnp.asarray([0.1, 0.0, 0.2]))
    added = np.asarray(biased.controls - data.controls)
    np.testing.assert_allclose(added, added[:, :1] + np.zeros_like(added), atol=1e-6)
    np.testing.assert_allclose(added[:, 0].std(axis=0), [0.1, 0.0, 0.2], rtol=0.3)
    np.testing.assert_array_equal(biased.states, data.states)


def simulated(transition, count, steps, seed):
    """Return windows drawn from a transition: a robot that stands at first, its rest at its prior."""
    controls = jax.random.uniform(jax.random.key(seed), (steps, transition.controls)) * 0.1
    start = transition.belief_at(np.zeros(3), translation_std=0.0, rotation_std=0.0)
    states = transition.extend(GaussianBelief(start.mean.body, 1e-12 * jnp.eye(3), PLANAR)).sample(
        jax.random.key(seed + 1), count
    )
    paths = transition.sample_paths(jax.random.key(seed + 2), states, controls, DT).body
    states = jnp.concatenate([states.body[:, None], paths], axis=1)
    return Windows(states, jnp.broadcast_to(controls, (count, *controls.shape)))


@pytest.mark.slow
def test_calibration_finds_the_noise_of_a_simulated_system():
    """Networks whose noise is half, or three times, that of what happens are given it back, within a step of gains."""
    true = noisy_transition(NOMINALS["holonomic"](), (0.02, 0.05), 3)
    held = [simulated(true, 24, 6, seed) for seed in (1, 2)]
    for wrong in (0.5, 3.0):
        members, gain = calibrate([with_gain(true, wrong)] * 2, held, DT, (0.0, 0.0))
        assert gain == pytest.approx(1.0 / wrong, rel=0.3)
        share = np.mean([coverage(member, windows, DT).mean() for member, windows in zip(members, held, strict=True)])
        assert abs(share - HELD_SHARE) < 0.05
    assert GAINS[1] / GAINS[0] < 1.2


def test_networks_that_agree_keep_the_spread_of_a_simulated_system():
    """The factor stays near one where all errors are noise, and envelopes hold what they should.

    The rest changes nothing here, so that one network and several equal ones have the same spread.
    """
    true = noisy_transition(NOMINALS["holonomic"](), (0.02, 0.05), 3)
    seen = simulated(true, 24, 6, 5)
    whole, factor = calibrate_together([true] * 3, seen, DT, (0.0, 0.0))
    assert 0.85 < factor <= 1.0
    assert abs(coverage(whole, seen, DT).mean() - HELD_SHARE) < 0.05


@pytest.mark.slow
def test_the_command_writes_a_transition_and_a_comparison(vssm, tmp_path):
    for name, seed in (("a", 1), ("b", 2)):
        (tmp_path / name).mkdir()
        write_euroc(tmp_path / name, dragged(24.0, seed, BIAS), packed=True)
    out = tmp_path / "learned.npz"
    asked = (tmp_path / "a", "--out", out, "--test", tmp_path / "b", "--horizon", 10, "--updates", 4)
    code, printed, warned = vssm("train-dynamics", *asked)
    assert code == 0
    assert "parametric" in printed
    assert str(out) in printed
    found = load_transition(out)
    assert found.kind == "imu"
    assert found.trained["updates"] == 4
    report = json.loads(out.with_suffix(".json").read_text())
    assert set(report["parts"]) == {"trained on", "held out", "test: b"}
    same = report["parts"]["held out"]["learned"]["position"] == report["parts"]["held out"]["bias"]["position"]
    assert same == ("warning: no update was better than `bias`" in warned)
    for rows in report["parts"].values():
        assert set(rows) == {"euler", "bias", "parametric", "learned"}
        assert set(rows["learned"]["position"]) == {"1", "3", "10"}
        assert 0.0 <= rows["learned"]["coverage"]["position"]["all steps"] <= 1.0
    state = found.transition.manifold.resting(jnp.eye(4))
    assert np.isfinite(np.asarray(found.transition.mean(state, jnp.zeros(6), DT).body.T_world_body)).all()
    code, _, errors = vssm("train-dynamics", *asked)
    assert code == 2
    assert "new file" in errors


@pytest.mark.slow
def test_an_interrupted_training_keeps_its_best(tmp_path):
    write_euroc(tmp_path, dragged(24.0, 1, BIAS))

    def interrupt(stage, done, total):
        if (stage, done) == ("training", 10):
            raise KeyboardInterrupt

    config = LearnConfig(horizon=10, fit=FitConfig(updates=500, members=2))
    found = learn([tmp_path], config=config, on_progress=interrupt)
    assert found.fitted.interrupted
    assert found.fitted.updates == 10
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found.fitted.transition))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--step", 0), "step"),
        (("--horizon", 1), "horizon"),
        (("--updates", 0), "updates"),
        (("--minutes", 0), "minutes"),
        (("--seed", -1), "seed"),
        (("--test", "nowhere"), "nowhere"),
    ],
)
def test_options_are_checked_before_anything_runs(options, expected, vssm, tmp_path):
    write_euroc(tmp_path, circling(4.0))
    code, _, errors = vssm("train-dynamics", tmp_path, "--out", tmp_path / "a.npz", *options)
    assert code == 2
    assert expected in errors
    assert errors.count("\n") == 1


def test_logs_of_two_kinds_are_refused(tmp_path):
    (tmp_path / "a").mkdir()
    write_euroc(tmp_path / "a", circling(4.0))
    write_recording(tmp_path / "b", (0.5, 0.0))
    with pytest.raises(InputError, match="kind imu"):
        learn([tmp_path / "a", tmp_path / "b"])


def test_a_log_that_is_too_short_is_refused(tmp_path):
    write_euroc(tmp_path, circling(2.5))
    with pytest.raises(InputError, match="times"):
        learn([tmp_path], config=LearnConfig(horizon=200))
