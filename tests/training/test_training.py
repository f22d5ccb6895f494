"""Test training: configurations, observations, a run with interruption and resume, and cloning."""

import json
import os
import re
import signal
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tests.chaos.disks import largest_file
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.policy.features import LAST_COMMANDS, features
from vssm_gym.cli.train import _summary, _times
from vssm_gym.errors import InputError, OutputError
from vssm_gym.geometry.scan import BEAMS
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.training import run as run_module
from vssm_gym.training.config import EnvironmentSettings, TrainingConfig, load_training, training_hash
from vssm_gym.training.environment import BODY, PolicyView, commands, make_observing
from vssm_gym.training.run import ENOUGH_EPISODES, ProgressLog, Run, deferred_interrupt, first_round, read_progress
from vssm_gym.training.train import run_training

PPO = {"name": "ppo", "n_steps": 8, "batch_size": 32, "n_epochs": 2}
SAC = {"name": "sac", "buffer_size": 500, "learning_starts": 32, "batch_size": 16}


class Corridor(VectorEnv):
    """Simulate robots on a line: the goal is ``left`` m ahead, and within 0.4 m of it the episode ends."""

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012
    single_observation_space = gym.spaces.Dict(
        {
            "scan": gym.spaces.Box(0.0, 8.0, (BEAMS,), np.float32),
            "goal": gym.spaces.Box(-9.0, 9.0, (3,), np.float32),
            "pose": gym.spaces.Box(-9.0, 9.0, (3,), np.float32),
        }
    )
    single_action_space = gym.spaces.Box(-1.0, 1.0, (4,), np.float32)

    def __init__(self, num_envs: int) -> None:
        self.num_envs = num_envs
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.left, self.steps = np.zeros(num_envs), np.zeros(num_envs, int)
        self.sent: list[np.ndarray] = []

    def _observe(self) -> dict[str, np.ndarray]:
        one, zero = np.ones(self.num_envs), np.zeros(self.num_envs)
        scan = np.tile(self.left[:, None], (1, BEAMS))
        found = {
            "scan": scan,
            "goal": np.stack([self.left, one, zero], -1),
            "pose": np.stack([-self.left, zero, zero], -1),
        }
        return {key: value.astype(np.float32) for key, value in found.items()}

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        self.left[mask], self.steps[mask] = 1.0, 0
        return self._observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        self.sent.append(actions)
        self.left, self.steps = self.left - actions[:, 2], self.steps + 1
        arrived, late = self.left <= 0.4, self.steps >= 12
        infos = {"success": arrived, "_success": arrived, "collision": np.arange(self.num_envs) == 1}
        return self._observe(), actions[:, 2].astype(np.float64), arrived, late & ~arrived, infos


def config(**changes: Any) -> TrainingConfig:
    fields: dict[str, Any] = {
        "name": "tiny",
        "environment": {"map": "unread.npz", "num_envs": 4},
        "policy": {"hidden": [8], "inputs": ["scan", "goal"]},
        "algorithm": PPO,
        "steps": 64,
    }
    return TrainingConfig.model_validate(fields | changes)


@pytest.fixture
def corridor(monkeypatch):
    """Make all trainings run in the corridor, for any map; skip without the extra."""
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    from vssm_gym.training import train as training

    monkeypatch.setattr(
        training, "make_training_env", lambda where, parts, seed: PolicyView(Corridor(where.num_envs), parts)
    )
    monkeypatch.setattr(training, "world_hash", lambda where: "0" * 16)


def contents(folder: Path) -> dict[Path, bytes]:
    """Return what all files of a folder hold."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# configurations


def written(path: Path, text: str) -> Path:
    (path / "train.yaml").write_text(text)
    return path / "train.yaml"


BASE = "name: a\nsteps: 10\nalgorithm: {name: ppo}\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- 1\n", "file: expected fields name, environment"),
        (BASE, "environment: expected this field"),
        (BASE + "environment: {}\n", r"environment.map: expected a map file"),
        (BASE + "environment: {id: vssm_gym/PointNav-v0}\n", "environment.scene: expected a scene"),
        (BASE + "environment: {map: m.npz, scene: oak}\n", "no 'scene'"),
        (BASE + "environment: {map: m.npz, end_on: stop}\n", "no 'end_on': training sets it"),
        (BASE + "environment: {map: m.npz, num_envs: 0}\n", "environment.num_envs"),
        (BASE + "environment: {map: m.npz, transition: a.npz, noise: low}\n", "no 'noise' beside 'transition'"),
        (BASE + "environment: {map: m.npz, transition: no.npz}\n", "environment.transition: expected a file"),
        (BASE + "environment: {id: vssm_gym/PointNav-v0, scene: oak, transition: a.npz}\n", "no 'transition'"),
        (BASE + "environment: {map: m.npz}\nfoo: 1\n", "foo: expected one of the fields name"),
        (BASE + "environment: {map: m.npz}\npolicy: {inputs: [scan]}\n", "'goal' among the inputs"),
        (BASE.replace("ppo", "dqn") + "environment: {map: m.npz}\n", "algorithm: expected"),
        (BASE.replace("{name: ppo}", "{name: ppo, tau: 1}") + "environment: {map: m.npz}\n", "algorithm.ppo.tau"),
        (BASE.replace("ppo", "bc") + "environment: {id: vssm_gym/PointNav-v0, scene: oak}\n", "the expert plans"),
        (
            BASE + "environment: {id: vssm_gym/PointNavGPS-v0, scene: oak}\n",
            "policy.inputs: expected scan, goal and commands",
        ),
        (
            BASE + "environment: {id: vssm_gym/PointNavGPS-v0, scene: oak, images: []}\n",
            "no 'images': training sets it",
        ),
    ],
)
def test_a_bad_configuration_is_one_clear_line(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as error:
        load_training(written(tmp_path, text))
    assert "\n" not in str(error.value)


def test_paths_start_at_the_file_and_hashes_at_the_content(tmp_path):
    path = written(tmp_path, BASE + "environment: {map: maps/oak.npz, noise: mid}\n")
    found, other = load_training(path), load_training(path, map_file=tmp_path / "other.npz")
    assert found.environment.map == str(tmp_path / "maps" / "oak.npz") != other.environment.map
    assert found.environment.keywords == {"noise": "mid"}
    assert training_hash(found, "a") == training_hash(other, "a") != training_hash(found, "b")
    assert training_hash(found, "a") != training_hash(load_training(path, seed=1), "a")
    hashes = [training_hash(found, "a")]
    path = written(tmp_path, BASE + "environment: {map: maps/oak.npz, transition: drive.npz}\n")
    for content in (b"a", b"b"):
        (tmp_path / "drive.npz").write_bytes(content)
        hashes.append(training_hash(load_training(path), "a"))
    assert len(set(hashes)) == 3


def test_a_missing_map_is_refused_before_anything_is_written(tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    wanted = load_training(written(tmp_path, BASE + "environment: {map: none.npz}\n"))
    with pytest.raises(InputError, match=r"none.npz: file: expected an existing map file"):
        run_training(wanted, tmp_path / "out")
    assert not (tmp_path / "out").exists()


# the environment


def test_a_training_without_a_map_observes_what_the_training_in_a_map_does():
    """Apart from the pose: PointNavGPS gives the scan and the goal of a wrapped PointNav with an observed pose."""
    shared = {"scene": "fern", "num_envs": 2, "noise": "mid", "max_episode_steps": 20}
    gps = make_observing(EnvironmentSettings(id="vssm_gym/PointNavGPS-v0", **shared))
    exact = make_observing(EnvironmentSettings(id="vssm_gym/PointNav-v0", **shared))
    seen, expected = gps.reset(seed=3)[0], exact.reset(seed=3)[0]
    for _ in range(4):
        np.testing.assert_array_equal(seen["scan"], expected["scan"])
        np.testing.assert_allclose(seen["goal"], expected["goal"], atol=1e-4)
        driven = commands(np.array([[0.2, 0.0, 1.0], [-1.0, 0.5, 0.0]]))
        seen, expected = gps.step(driven)[0], exact.step(driven)[0]


def test_actions_span_the_robots_commands():
    low, middle, high = commands(np.array([[-1.0, -1.0, -1.0], [0.0, 0.0, 0.0], [7.0, 1.0, 1.0]]))
    np.testing.assert_allclose(low, [*BODY.low, 0.0], atol=1e-6)
    np.testing.assert_allclose(middle, [0.0, 0.0, 0.08, 0.0], atol=1e-6)
    np.testing.assert_allclose(high, [*BODY.high, 0.0], atol=1e-6)


def test_a_view_has_features_and_marks_arrivals():
    env = PolicyView(Corridor(2), ("scan", "goal"))
    first, _ = env.reset()
    np.testing.assert_array_equal(first, features(env.shown, ("scan", "goal")))
    assert env.single_observation_space.contains(first[0])
    actions = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], np.float32)
    infos = [env.step(actions)[-1] for _ in range(12)]
    assert infos[0] == {}
    assert infos[3]["is_success"].tolist() == [True, False] and infos[3]["_is_success"].tolist() == [True, False]
    assert infos[11]["_is_success"][1] and not infos[11]["is_success"][1]


def test_a_view_shows_the_last_commands_of_an_episode():
    """Newest first, as the environment gets them; none is left where an episode begins."""
    where = EnvironmentSettings(id="vssm_gym/PointNav-v0", scene="fern", num_envs=2, max_episode_steps=3)
    env = PolicyView(make_observing(where), ("goal", "commands"))
    env.reset(seed=0)
    rng, sent = np.random.default_rng(0), []
    for step in range(1, 7):
        actions = rng.uniform(-1.0, 1.0, (2, 3))
        sent = [commands(actions)[:, :3], *sent] if step != 4 else []  # the fourth step begins the next episode
        env.step(actions)
        expected = np.zeros((2, LAST_COMMANDS, 3))
        expected[:, : len(sent)] = np.stack(sent, axis=1)[:, :LAST_COMMANDS] if sent else 0.0
        np.testing.assert_allclose(env.shown["commands"], expected, atol=1e-6)
    env.reset(options={"reset_mask": np.array([True, False])})
    assert (env.shown["commands"][0] == 0.0).all() and (env.shown["commands"][1] != 0.0).any()
    env.close()


def test_collisions_have_the_configured_cost():
    free, dear = (PolicyView(Corridor(2), ("goal",), cost) for cost in (0.0, 0.25))
    rewards = []
    for env in (free, dear):
        env.reset()
        rewards.append(env.step(np.zeros((2, 3), np.float32))[1])
    np.testing.assert_allclose(rewards[0] - rewards[1], [0.0, 0.25])


# runs


@pytest.mark.parametrize("algorithm", [PPO, SAC], ids=["ppo", "sac"])
@pytest.mark.parametrize("frames", [1, 3])
def test_a_run_is_resumed_where_it_was(corridor, tmp_path, algorithm, frames):
    """Steps, seconds and the network continue; the file acts as the trained network."""
    import torch

    from vssm_gym.training.sb3.learner import make_model, restore_checkpoint, wrapped

    shape = {"policy": {"hidden": [8], "inputs": ["scan", "goal"], "frames": frames}, "algorithm": algorithm}
    path = run_training(config(**shape), tmp_path / "run")
    rows = read_progress(tmp_path / "run" / "progress.jsonl")
    assert rows[-1]["steps"] == 64 and rows[-1]["seconds"] > rows[-1]["preparing"] > 0.0
    policy = policy_file.load(path)
    assert policy.spec.trained["steps"] == 64 and policy.spec.frames == frames

    wanted = config(**shape)
    env = wrapped(PolicyView(Corridor(4), ("scan", "goal")), frames)
    settings = wanted.algorithm.model_dump(exclude={"name"})
    model = make_model(wanted.algorithm.name, env, (8,), "tanh", 0, settings, lambda: 0.0, tmp_path / "log")
    assert restore_checkpoint(tmp_path / "run" / "checkpoint.pt", model) >= rows[-1]["seconds"] - 1e-4  # rounded
    assert model.num_timesteps == 64
    if algorithm is SAC:
        assert model.replay_buffer.pos == 16  # type: ignore[attr-defined]
    x = np.random.default_rng(0).normal(size=(5, frames * 68)).astype(np.float32)
    with torch.no_grad():
        theirs, _ = model.predict(x, deterministic=True)
    np.testing.assert_allclose(policy(x), commands(theirs)[:, :3], atol=1e-5)

    with pytest.raises(InputError, match="--resume continues"):
        run_training(wanted, tmp_path / "run")
    before = contents(tmp_path / "run")
    assert run_training(wanted, tmp_path / "run", resume=True) == path and contents(tmp_path / "run") == before
    with pytest.raises(InputError, match="another training belongs into another folder"):
        run_training(config(**shape, seed=5), tmp_path / "run", resume=True)


def test_ctrl_c_keeps_the_training_and_resume_completes_it(corridor, tmp_path):
    def interrupt(row: dict[str, Any], share: float) -> None:
        if row["steps"] == 64:
            os.kill(os.getpid(), signal.SIGINT)

    long = config(steps=160)
    with pytest.raises(KeyboardInterrupt):
        run_training(long, tmp_path, on_update=interrupt)
    rows = read_progress(tmp_path / "progress.jsonl")
    assert 64 <= rows[-1]["steps"] < 100 and (tmp_path / "policy.npz").is_file()
    run_training(long, tmp_path, resume=True)
    again = read_progress(tmp_path / "progress.jsonl")
    assert again[: len(rows)] == rows and again[-1]["steps"] >= 160
    assert again[-1]["seconds"] > rows[-1]["seconds"]
    assert json.loads((tmp_path / "training.json").read_text())["world_hash"] == "0" * 16


# what is shown of a training


def running(path: Path, heard: list[dict[str, Any]], **changes: Any) -> Run:
    """Return a training of 4 robots with episodes of 12 steps whose updates are heard."""
    where = {"map": "unread.npz", "num_envs": 4, "max_episode_steps": 12}
    manifest = {"config_hash": "", "world_hash": "", "version": ""}
    log = ProgressLog(path / "progress.jsonl")
    return Run(
        config(environment=where, **changes), path, manifest, log, lambda: False, lambda row, _: heard.append(row)
    )


def update(steps: int, episodes: int) -> dict[str, Any]:
    return {"steps": steps, "episodes": episodes, "return": 1.0, "length": 3.0, "success": 1.0}


def test_success_is_enough_after_100_episodes_and_a_round_of_all_robots(tmp_path):
    """The first episodes are short ones; a resumed training begins with such episodes again."""
    heard: list[dict[str, Any]] = []
    run = running(tmp_path, heard)
    assert first_round(run.config) == 48
    run.stepped()
    for steps, episodes in ((44, 400), (48, 99), (48, ENOUGH_EPISODES)):
        run.report(update(steps, episodes), lambda: None)
    assert [row["enough"] for row in heard] == [False, False, True]
    again = running(tmp_path, heard)
    again.resume(48, 5.0)
    again.stepped()
    for steps in (92, 96):
        again.report(update(steps, 500), lambda: None)
    assert [row["enough"] for row in heard[3:]] == [False, True]


def test_the_command_shows_no_success_of_a_handful_of_episodes(tmp_path):
    few, one, enough = update(44, 7), update(12, 1), update(9600, 500)
    shown = [_summary(row | {"enough": row is enough}, running(tmp_path, []).config) for row in (few, one, enough)]
    assert shown == [
        "44 steps, 7 episodes ended; success needs 100 and 48 steps of this run",
        "12 steps, 1 episode ended; success needs 100 and 48 steps of this run",
        "9,600 steps, return 1.00, success 100%",
    ]


def test_building_and_compiling_are_timed_apart(tmp_path, monkeypatch):
    """Two sessions: 20 + 5 s until the first step, 70 + 10 s afterwards."""
    now, heard = [1000.0], list[dict[str, Any]]()
    monkeypatch.setattr(run_module.time, "monotonic", lambda: now[0])
    run = running(tmp_path, heard)
    now[0] += 20.0
    run.report(update(0, 0), lambda: None)
    assert heard == []  # the robots have not stepped
    run.stepped()
    now[0] += 70.0
    run.stepped()
    run.end(update(640, 0), lambda: None)
    assert (heard[-1]["seconds"], heard[-1]["preparing"]) == (90.0, 20.0)

    again = running(tmp_path, heard)
    again.resume(640, 90.0)
    now[0] += 5.0
    again.stepped()
    now[0] += 10.0
    again.end(update(800, 0), lambda: None)
    assert (heard[-1]["seconds"], heard[-1]["preparing"]) == (105.0, 25.0)
    shown = "trained 105.0 s: 25.0 s building and compiling, 80.0 s stepping and learning (10 steps/s)"
    assert _times(heard[-1]) == shown


def test_a_training_has_finished_when_its_policy_is_of_the_end(tmp_path, monkeypatch):
    """After all steps or all minutes, of which the policy states tenths of seconds."""
    now, layers = [1000.0], ((np.zeros((8, 68)), np.zeros(8)), (np.zeros((3, 8)), np.zeros(3)))
    monkeypatch.setattr(run_module.time, "monotonic", lambda: now[0])
    run = running(tmp_path, [], steps=640, minutes=0.12567)  # 7.54 s
    found = [run.finished()]
    for steps, seconds in ((0, 7.0), (600, 7.41), (640, 7.0), (600, 7.541)):
        run.steps, now[0] = steps, 1000.0 + seconds
        run.write_policy(layers, "clip")
        found.append(run.finished())
    assert found == [False, False, False, True, True]


# trainings that diverge


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_a_row_is_of_finite_numbers(tmp_path, number):
    run = running(tmp_path, [])
    for write in (run.report, run.end):
        with pytest.raises(InputError, match=r"learning_rate: expected less than 0.0005, .* diverged at step 1,200"):
            write(update(1200, 7) | {"loss": number}, lambda: pytest.fail("it was kept"))
    assert (tmp_path / "progress.jsonl").read_bytes() == b""


@pytest.mark.parametrize(("algorithm", "rate"), [(PPO, 10.0), (PPO, 1e3), (SAC, 10.0)], ids=["mean", "width", "sac"])
def test_a_diverged_training_keeps_what_was_finite(corridor, tmp_path, monkeypatch, algorithm, rate):
    """The densities of PPO lose their mean, or their width."""
    for name in ("ROW_SECONDS", "CHECKPOINT_SECONDS"):
        monkeypatch.setattr(run_module, name, 0.0)
    wanted = config(algorithm=algorithm | {"learning_rate": rate}, steps=4000)
    expected = rf"learning_rate: expected less than {rate:g}, with which the training diverged at step [1-9]"
    with pytest.raises(InputError, match=expected):
        run_training(wanted, tmp_path)
    steps = policy_file.load(tmp_path / "policy.npz").spec.trained["steps"]  # which refuses what is not finite
    assert steps <= read_progress(tmp_path / "progress.jsonl")[-1]["steps"] < 4000
    assert (tmp_path / "checkpoint.pt").is_file()


def test_a_training_that_diverges_in_its_last_update_keeps_nothing_of_it(corridor, tmp_path, monkeypatch):
    from vssm_gym.training.sb3 import learner

    learn = learner.learn

    def diverge(model, *given):
        learn(model, *given)
        model.policy.action_net.bias.data.fill_(np.nan)

    monkeypatch.setattr(learner, "learn", diverge)
    with pytest.raises(InputError, match="the training diverged at step 64"):
        run_training(config(), tmp_path)
    assert not list(tmp_path.glob("*.pt")) and not list(tmp_path.glob("*.npz"))


class Bomb:
    """Write a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("damage", ["text", "code"])
def test_a_damaged_checkpoint_is_refused_and_runs_no_code(corridor, tmp_path, damage):
    import torch

    run_training(config(), tmp_path / "run").unlink()  # as if it had been killed before its end
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    if damage == "text":
        checkpoint.write_bytes(b"not a checkpoint")
    else:
        torch.save({"model": Bomb(tmp_path / "exploded")}, checkpoint)
    with pytest.raises(InputError, match="a checkpoint of this training"):
        run_training(config(), tmp_path / "run", resume=True)
    assert not (tmp_path / "exploded").exists()


@pytest.mark.parametrize(
    "change",
    [
        {"counters": {"num_timesteps": 64, "_n_updates": 1, "save": 0}},
        {"counters": {"num_timesteps": 64}},
        {"counters": {"num_timesteps": -1, "_n_updates": 1}},
        {"counters": {"num_timesteps": 1.5, "_n_updates": 1}},
        {"variables": {"policy": 0}},
    ],
)
def test_a_checkpoint_with_other_variables_is_refused(corridor, tmp_path, change):
    import torch

    run_training(config(), tmp_path / "run").unlink()
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    content = torch.load(checkpoint, weights_only=True)
    torch.save(content | change, checkpoint)
    with pytest.raises(InputError, match="a checkpoint of this training"):
        run_training(config(), tmp_path / "run", resume=True)


def test_a_training_killed_before_its_first_checkpoint_restarts(corridor, tmp_path):
    """Its log is dropped, so that steps along a curve never decrease."""
    run_training(config(), tmp_path)
    for name in ("checkpoint.pt", "policy.npz"):
        (tmp_path / name).unlink()
    run_training(config(), tmp_path, resume=True)
    steps = [row["steps"] for row in read_progress(tmp_path / "progress.jsonl")]
    assert steps == sorted(steps) and steps[-1] == 64


@pytest.mark.parametrize("changed", [{}, {"steps": 80}])
def test_a_finished_policy_is_not_overwritten(corridor, tmp_path, changed):
    """This holds without a checkpoint too, as after cloning."""
    path = run_training(config(), tmp_path)
    (tmp_path / "checkpoint.pt").unlink()
    before = path.read_bytes()
    with pytest.raises(InputError, match="config_hash" if changed else "--resume continues"):
        run_training(config(**changed), tmp_path)
    assert path.read_bytes() == before


def test_a_folder_with_other_files_is_refused(corridor, tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match=r"it holds thesis.tex"):
        run_training(config(), tmp_path)


def test_a_log_forgets_what_was_not_kept_and_rewrites_nothing(tmp_path):
    """Lines that are kept stay where they are: a kill or a full disk cannot cost them."""
    path = tmp_path / "log"
    with ProgressLog(path) as log:
        for steps in (10, 20, 30):
            log.append({"steps": steps, "seconds": 1.0})
        kept = path.read_bytes()[: 2 * len(b'{"steps": 10, "seconds": 1.0}\n')]
        with largest_file(len(kept) - 1):
            log.drop_after(20)
        assert path.read_bytes() == kept
        log.append({"steps": 25, "seconds": 1.0})
    path.write_bytes(path.read_bytes() + b'{"ste')
    with ProgressLog(path) as log:
        log.drop_after(40)
    assert [row["steps"] for row in read_progress(path)] == [10, 20, 25] and path.read_bytes().endswith(b"\n")
    path.write_bytes(path.read_bytes() + b'{"seconds": 2.0}\n')
    with ProgressLog(path) as log, pytest.raises(InputError, match=r"line 4: expected numbers as seconds and steps"):
        log.drop_after(40)


def test_a_full_disk_ends_a_training_and_resume_ends_it(corridor, tmp_path):
    """The network is smaller than the optimiser's state beside it: the checkpoint does not fit."""
    with pytest.raises(OutputError, match=r"could not be written: File too large"), largest_file(8000):
        run_training(config(), tmp_path)
    assert not (tmp_path / "checkpoint.pt").exists() and not list(tmp_path.glob(".*"))
    run_training(config(), tmp_path, resume=True)
    assert read_progress(tmp_path / "progress.jsonl")[-1]["steps"] == 64


def test_a_folder_has_one_training_at_a_time(corridor, tmp_path):
    def meanwhile(row: dict[str, Any], share: float) -> None:
        with pytest.raises(InputError, match="no other run writing to it at the same time"):
            run_training(config(), tmp_path, resume=True)

    run_training(config(), tmp_path, on_update=meanwhile)


def test_a_second_interrupt_stops_at_once():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), deferred_interrupt() as seen:
        assert not seen()
        os.kill(os.getpid(), signal.SIGINT)
        assert seen()
        os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_cloning_fits_its_data():
    pytest.importorskip("torch", reason="needs the extra vssm-gym[rl]")
    from vssm_gym.training.sb3.cloning import fit

    rng = np.random.default_rng(0)
    x = rng.normal(size=(512, 4)).astype(np.float32)
    a = np.tanh(x @ rng.normal(size=(4, 3))).astype(np.float32)
    losses: list[float] = []
    layers = fit(
        x, a, (32,), "tanh", epochs=60, batch_size=64, learning_rate=0.01, seed=0,
        on_epoch=lambda epoch, loss: losses.append(loss), stop=lambda: False,
    )  # fmt: skip
    assert losses[-1] < 0.05 * losses[0]
    hidden = np.tanh(x @ layers[0][0].T + layers[0][1])
    assert np.mean((hidden @ layers[1][0].T + layers[1][1] - a) ** 2) < 0.05 * losses[0]


@pytest.mark.slow
def test_interrupted_cloning_writes_no_policy_and_is_resumed(tmp_path):
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    from tests.helpers.imagined_room import room

    room().save(tmp_path / "room.npz")
    settings = {"environment": {"map": str(tmp_path / "room.npz"), "num_envs": 4, "pool": 64, "goals": 4}, "steps": 400}
    wanted = config(**settings, algorithm={"name": "bc", "epochs": 2})

    def interrupt(row: dict[str, Any], share: float) -> None:
        if row["steps"] == 200:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run_training(wanted, tmp_path / "run", on_update=interrupt)
    assert not (tmp_path / "run" / "policy.npz").exists()
    with np.load(tmp_path / "run" / "demonstrations.npz") as kept:
        assert int(kept["steps"]) == 200 and 100 < len(kept["vectors"]) == len(kept["actions"]) <= 200
    path = run_training(wanted, tmp_path / "run", resume=True)
    assert policy_file.load(path).spec.trained["steps"] == 400
    assert not (tmp_path / "run" / "demonstrations.npz").exists()
    rows = read_progress(tmp_path / "run" / "progress.jsonl")
    assert [row["steps"] for row in rows] == sorted(row["steps"] for row in rows)


def test_tracking_errors_are_added_to_the_simulators_poses():
    """They have the configured standard deviations, from an exact start; the goal is relative to the erroneous pose."""
    where = {"id": "vssm_gym/PointNav-v0", "scene": "oak", "num_envs": 4, "max_episode_steps": 40}
    exact, tracked = (
        make_observing(EnvironmentSettings(**where, pose_std=std)) for std in ((0.0, 0.0, 0.0), (0.02, 0.04, 0.01))
    )
    true, tracked_ = (env.reset(seed=0)[0] for env in (exact, tracked))
    np.testing.assert_allclose(tracked_["pose"], true["pose"], atol=1e-6)
    errors, action = [], np.tile(np.array([0.1, 0.0, 0.0, 0.0], np.float32), (4, 1))
    for _ in range(80):
        true, tracked_ = (env.step(action)[0] for env in (exact, tracked))
        c, s = np.cos(true["pose"][:, 2]), np.sin(true["pose"][:, 2])
        dx, dy, turn = (tracked_["pose"] - true["pose"]).T
        errors.append(np.stack([c * dx + s * dy, c * dy - s * dx, wrap_angle(turn)], axis=-1))
    np.testing.assert_allclose(errors[40], 0.0, atol=1e-6)  # all episodes have restarted
    assert np.abs(tracked_["goal"] - true["goal"]).max() > 1e-3
    np.testing.assert_allclose(np.std(np.concatenate(errors), axis=0), [0.02, 0.04, 0.01], rtol=0.3)
    for env in (exact, tracked):
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "bc"])
def test_a_training_in_a_learned_map(tmp_path, algorithm, monkeypatch):
    """The command line trains from a map file to a policy file, which then runs in the same map."""
    pytest.importorskip("stable_baselines3", reason="needs the extra vssm-gym[rl]")
    from tests.helpers.imagined_room import room, task
    from vssm_gym.cli.train import train
    from vssm_gym.training.imagined_episodes import imagine

    room().save(tmp_path / "room.npz")
    settings = "{name: ppo, n_steps: 16, batch_size: 64}" if algorithm == "ppo" else "{name: bc, epochs: 3}"
    text = f"name: room\nsteps: 256\nalgorithm: {settings}\npolicy: {{hidden: [16]}}\n"
    path = written(tmp_path, text + "environment: {map: room.npz, num_envs: 4, pool: 64, goals: 4}\n")
    train(path, tmp_path / "run")
    policy = policy_file.load(tmp_path / "run" / "policy.npz")
    assert policy.spec.trained["algorithm"] == algorithm
    assert re.fullmatch(r"[0-9a-f]{16}", policy.spec.trained["world_hash"])
    if algorithm == "ppo":
        train(path, tmp_path / "run", resume=True)
    tasks = [task((1.0, 1.2, 0.0), (3.0, 1.2))]
    object.__setattr__(tasks[0], "geodesic", 1.6)
    (row,) = imagine(policy, tmp_path / "room.npz", tasks, "none")
    assert 0.0 <= row["spl"] <= row["success"] and 1 <= row["steps"] <= 500
