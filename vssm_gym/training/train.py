"""Train a policy until its steps or minutes are over, and resume after interruptions: ``train CONFIG --out DIR``.

The folder holds ``training.json`` (configuration, hashes, versions), ``progress.jsonl`` (one line every few seconds and
at every checkpoint), ``checkpoint.pt`` or ``checkpoint.npz`` (for ``--resume``), ``policy.npz`` (for agents) and, of
stable-baselines3, ``logs``. Seconds count the whole training; those of the environment's construction and compilation,
until the first step has ended, are stated as ``preparing`` too.
"""

import importlib.metadata
import importlib.util
from pathlib import Path
from typing import Any

from vssm_gym.errors import InputError
from vssm_gym.files.output_folders import Owner, check_folder, owned_folder
from vssm_gym.training.cloning import DEMONSTRATIONS, clone
from vssm_gym.training.config import TrainingConfig, training_hash
from vssm_gym.training.environment import make_training_env, stream, world_hash
from vssm_gym.training.run import (
    POLICY,
    OnUpdate,
    ProgressLog,
    Row,
    Run,
    TrainingProgress,
    deferred_interrupt,
    falling_rate,
)
from vssm_gym.version import package_version

MANIFEST, PROGRESS, LOGS = "training.json", "progress.jsonl", "logs"
CHECKPOINT, JAX_CHECKPOINT = "checkpoint.pt", "checkpoint.npz"
BEGUN = (CHECKPOINT, JAX_CHECKPOINT, DEMONSTRATIONS, POLICY)  # what a training resumes from, or has ended with
RL_EXTRA = ("stable_baselines3", "torch")
LIBRARIES = ("numpy", "jax", "gymnasium")


def run_training(config: TrainingConfig, out: Path, *, resume: bool = False, on_update: OnUpdate | None = None) -> Path:
    """Train a policy and return its file.

    Ctrl-C lets the current rollout and update end (seconds), keeps them and raises KeyboardInterrupt; a second one does
    not wait.

    Args:
        config: checked by :func:`vssm_gym.training.config.load_training`.
        out: new or empty folder, or with ``resume`` that of a training of the same configuration.
        resume: continue from the last checkpoint: parameters, optimiser, steps, seconds, random generators. Running
            episodes restart, so that an interrupted training is not the same to the last bit. Of a training that has
            ended no file changes.
        on_update: called after every update with a row of the log and the fraction that is done.

    Raises:
        InputError: the folder of another or of a running training, or an invalid map, scene or keyword; a training
            that diverges, whose last checkpoint and policy are kept.
        OutputError: a full disk or the like; the last checkpoint is kept.
    """
    compiled = config.algorithm.name == "ppo_jax"
    if not compiled:
        _check_extra()
    check_folder(out)
    manifest = _manifest(config)
    owner = Owner("training", MANIFEST, manifest, resumed=BEGUN)
    with (
        owned_folder(out, owner, resume),
        ProgressLog(out / PROGRESS) as log,
        deferred_interrupt() as interrupted,
    ):
        run = Run(config, out, manifest, log, interrupted, on_update or (lambda row, fraction: None))
        if config.algorithm.name == "bc":
            clone(run)
        elif not run.finished():
            (_reinforce_compiled if compiled else _reinforce)(run)
    if interrupted():
        raise KeyboardInterrupt
    return out / POLICY


def _reinforce(run: Run) -> None:
    """Train by PPO or SAC."""
    from vssm_gym.training.sb3.learner import (
        REFUSED,
        layers_of,
        learn,
        make_model,
        restore_checkpoint,
        save_checkpoint,
        training_progress,
        wrapped,
    )

    config = run.config
    env = wrapped(make_training_env(config.environment, config.policy.inputs, config.seed), config.policy.frames)
    settings = config.algorithm.model_dump(exclude={"name"})
    network = config.policy.hidden, config.policy.activation
    logs = run.out / LOGS / str(len(list((run.out / LOGS).glob("*"))))
    model = make_model(config.algorithm.name, env, *network, config.seed, settings, run.fraction_done, logs)
    checkpoint = run.out / CHECKPOINT
    if checkpoint.is_file():
        seconds = restore_checkpoint(checkpoint, model)
        run.resume(model.num_timesteps, seconds)
    else:
        run.begin()
    env.seed(stream(config.seed, model.num_timesteps))

    def keep() -> None:
        run.check(one.detach().numpy() for one in model.policy.parameters())
        save_checkpoint(checkpoint, model, run.seconds)
        run.write_policy(layers_of(model), "tanh" if config.algorithm.name == "sac" else "clip")

    try:
        learn(model, config.steps, lambda now: run.report(_row(now), keep), run.over, run.stepped)
        run.end(_row(training_progress(model)), keep)
    except ValueError as error:
        if REFUSED not in str(error):
            raise
        run.steps = model.num_timesteps
        raise run.diverged() from error
    finally:
        model.logger.close()
        env.close()


def _reinforce_compiled(run: Run) -> None:
    """Train by PPO in one compiled program."""
    from vssm_gym.training.ppo_jax.learner import Learner

    config, checkpoint, learner = run.config, run.out / JAX_CHECKPOINT, Learner(run.config)
    assert config.algorithm.name == "ppo_jax"
    if checkpoint.is_file():
        seconds = learner.restore(checkpoint)
        run.resume(learner.steps, seconds)
    else:
        run.begin()

    def keep() -> None:
        run.check(learner.leaves())
        learner.save(checkpoint, run.seconds)
        run.write_policy(learner.policy_layers(), "clip")

    while learner.steps < config.steps and not run.over():
        learner.update(falling_rate(config.algorithm.learning_rate, run.fraction_done()))
        run.stepped()
        run.report(_row(learner.progress()) | learner.statistics, keep)
    run.end(_row(learner.progress()), keep)


def _row(now: TrainingProgress) -> Row:
    number = lambda value: None if value is None else round(value, 4)
    return {
        "steps": now.steps,
        "episodes": now.episodes,
        "return": number(now.mean_return),
        "length": number(now.mean_length),
        "success": number(now.success),
    }


def _check_extra() -> None:
    if not all(importlib.util.find_spec(name) for name in RL_EXTRA):
        raise InputError("train", "stable-baselines3", 'the extra "rl": pip install -c constraints.txt ".[rl]"')


def _manifest(config: TrainingConfig) -> dict[str, Any]:
    world = world_hash(config.environment)
    libraries = LIBRARIES if config.algorithm.name == "ppo_jax" else (*RL_EXTRA, *LIBRARIES)
    return {
        "config": config.model_dump(mode="json"),
        "config_hash": training_hash(config, world),
        "world_hash": world,
        "version": package_version(),
        "libraries": {name: importlib.metadata.version(name) for name in libraries},
    }
