"""``train CONFIG --out DIR``: a policy learns until its steps or minutes are over, whatever interrupts it.

The folder holds ``training.json`` (configuration, hashes, versions), ``progress.jsonl`` (one line every few seconds and
at every checkpoint), ``checkpoint.pt`` (what ``--resume`` goes on from), ``policy.npz`` (what agents load) and
``logs``. Seconds are of the whole training, the environment's construction and compilation among them.
"""

import contextlib
import fcntl
import importlib.metadata
import importlib.util
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from vssm_gym.agents.policy_file import Policy, PolicySpec, save
from vssm_gym.errors import InputError
from vssm_gym.eval.cloning import DEMONSTRATIONS, clone
from vssm_gym.eval.destinations import check_folder
from vssm_gym.eval.training_config import TrainingConfig, training_hash
from vssm_gym.eval.training_env import BODY, make_training_env, stream, world_hash
from vssm_gym.eval.version import package_version
from vssm_gym.files import atomic_write

MANIFEST, PROGRESS, CHECKPOINT, POLICY, LOGS = (
    "training.json", "progress.jsonl", "checkpoint.pt", "policy.npz", "logs",
)  # fmt: skip
ROW_SECONDS, CHECKPOINT_SECONDS = 5.0, 60.0
BEGUN = (CHECKPOINT, DEMONSTRATIONS, POLICY)  # any of them is worth keeping
LIBRARIES = ("stable_baselines3", "torch", "numpy", "jax", "gymnasium")

Row = dict[str, Any]  # of progress.jsonl: seconds, steps, episodes, return, length, success
Told = Callable[[Row, float], None]  # a row, and the share of the training that is done


def run_training(config: TrainingConfig, out: Path, *, resume: bool = False, told: Told | None = None) -> Path:
    """Train; returns the policy's file.

    Ctrl-C lets the rollout and the update under way end (seconds), keeps them and raises KeyboardInterrupt; a second
    one does not wait.

    Args:
        config: checked by :func:`vssm_gym.eval.training_config.load_training`.
        out: new or empty folder, or with ``resume`` that of a training of the same configuration.
        resume: go on from the last checkpoint: parameters, optimiser, steps, seconds, random generators. Episodes that
            were under way begin anew, so that a training which was interrupted is not the same to the last bit.
        told: how it goes, after every update.

    Raises:
        InputError: another training's folder, one that is running, a map, scene or keyword that does not fit.
    """
    _check_extra()
    check_folder(out)
    manifest = _manifest(config)
    out.mkdir(parents=True, exist_ok=True)
    with ProgressLog(out / PROGRESS) as log, deferred_interrupt() as interrupted:
        _claim(out, manifest, resume)
        run = Run(config, out, manifest, log, interrupted, told or (lambda row, share: None))
        if config.algorithm.name == "bc":
            clone(run)
        else:
            _reinforce(run)
    if interrupted():
        raise KeyboardInterrupt
    return out / POLICY


class Run:
    """One training under way: its clock, its limits, and what it writes."""

    def __init__(
        self,
        config: TrainingConfig,
        out: Path,
        manifest: dict[str, Any],
        log: "ProgressLog",
        interrupted: Callable[[], bool],
        told: Told,
    ) -> None:
        self.config, self.out = config, out
        self._manifest, self._log, self._told = manifest, log, told
        self.interrupted = interrupted
        self.steps = 0  # of all robots together
        self._began = time.monotonic()
        self._row_at = self._kept_at = 0.0

    @property
    def policy_file(self) -> Path:
        """Where :meth:`write_policy` writes."""
        return self.out / POLICY

    @property
    def seconds(self) -> float:
        """Trained so far, those of earlier sessions among them."""
        return time.monotonic() - self._began

    def begin(self) -> None:
        """From nothing: what one that was killed before its first checkpoint has logged is dropped."""
        self._log.drop_after(-1)

    def go_on(self, steps: int, seconds: float) -> None:
        """Count on from a checkpoint; what was logged after it is dropped."""
        self.steps = steps
        self._began -= seconds
        self._row_at = self._kept_at = self.seconds
        self._log.drop_after(steps)

    def share(self) -> float:
        """Of the training that is done, in [0, 1]."""
        minutes = self.config.minutes
        return min(1.0, max(self.steps / self.config.steps, self.seconds / (60.0 * minutes) if minutes else 0.0))

    def over(self) -> bool:
        """Whether to end now: interrupted, or out of time."""
        minutes = self.config.minutes
        return self.interrupted() or (minutes is not None and self.seconds >= 60.0 * minutes)

    def tell(self, row: Row, keep: Callable[[], None]) -> None:
        """Note how it goes, and from time to time ``keep()`` what was learned."""
        self.steps = row["steps"]
        row = {"seconds": round(self.seconds, 2), **row}
        self._told(row, self.share())
        due = self.seconds - self._kept_at >= CHECKPOINT_SECONDS
        if due or self.seconds - self._row_at >= ROW_SECONDS:
            self._log.append(row)
            self._row_at = self.seconds
        if due:
            keep()
            self._kept_at = self.seconds

    def end(self, row: Row, keep: Callable[[], None]) -> None:
        """The last row and the last checkpoint of this session."""
        self.steps = row["steps"]
        keep()
        row = {"seconds": round(self.seconds, 2), **row}
        self._log.append(row)
        self._told(row, self.share())

    def write_policy(self, layers: tuple[tuple[np.ndarray, np.ndarray], ...], squash: str) -> None:
        """``policy.npz``: the network as it is now."""
        config = self.config
        trained = {
            "algorithm": config.algorithm.name,
            "environment": config.environment.id,
            "steps": self.steps,
            "seconds": round(self.seconds, 1),
            "seed": config.seed,
            **{key: self._manifest[key] for key in ("config_hash", "world_hash", "version")},
        }
        spec = PolicySpec(
            name=config.name,
            parts=config.policy.inputs,
            frames=config.policy.frames,
            hidden=config.policy.hidden,
            activation=config.policy.activation,
            squash=squash,
            low=tuple(BODY.low.tolist()),
            high=tuple(BODY.high.tolist()),
            max_depth=BODY.max_depth,
            hfov=BODY.hfov,
            success_radius=BODY.success_radius,
            trained=trained,
        )
        save(self.policy_file, Policy(spec, layers))


def _reinforce(run: Run) -> None:
    """PPO or SAC."""
    from vssm_gym.agents.sb3.learner import (
        layers_of,
        learn,
        make_model,
        restore_checkpoint,
        save_checkpoint,
        stage,
        wrapped,
    )

    config = run.config
    env = wrapped(make_training_env(config.environment, config.policy.inputs, config.seed), config.policy.frames)
    settings = config.algorithm.model_dump(exclude={"name"})
    network = config.policy.hidden, config.policy.activation
    logs = run.out / LOGS / str(len(list((run.out / LOGS).glob("*"))))
    model = make_model(config.algorithm.name, env, *network, config.seed, settings, run.share, logs)
    checkpoint = run.out / CHECKPOINT
    if checkpoint.is_file():
        seconds = restore_checkpoint(checkpoint, model)
        run.go_on(model.num_timesteps, seconds)
    else:
        run.begin()
    env.seed(stream(config.seed, model.num_timesteps))

    def keep() -> None:
        run.write_policy(layers_of(model), "tanh" if config.algorithm.name == "sac" else "clip")
        save_checkpoint(checkpoint, model, run.seconds)

    try:
        learn(model, config.steps, lambda now: run.tell(_row(now), keep), run.over)
        run.end(_row(stage(model)), keep)
    finally:
        model.logger.close()
        env.close()


def _row(now: Any) -> Row:
    number = lambda value: None if value is None else round(value, 4)
    return {
        "steps": now.steps,
        "episodes": now.episodes,
        "return": number(now.mean_return),
        "length": number(now.mean_length),
        "success": number(now.success),
    }


class ProgressLog:
    """``progress.jsonl`` and its one writer: a lock keeps a second training out of the folder."""

    def __init__(self, path: Path) -> None:
        self._path, self._file = path, path.open("ab")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.close()
            raise InputError(path, "file", "no other training writing it at the same time") from error

    def append(self, row: Row) -> None:
        """Add a line."""
        self._file.write(json.dumps(row, allow_nan=False).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def drop_after(self, steps: int) -> None:
        """Forget lines later than ``steps``, and one that a crash left unfinished."""
        kept = [json.dumps(row) for row in read_progress(self._path) if row["steps"] <= steps]
        self._file.truncate(0)  # appending goes on at the new end
        self._file.write("".join(line + "\n" for line in kept).encode())
        self._file.flush()

    def __enter__(self) -> "ProgressLog":
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()


def read_progress(path: Path) -> list[Row]:
    """The lines of a ``progress.jsonl``; an unfinished last one is left out."""
    data = path.read_bytes()
    return [json.loads(line) for line in data[: data.rfind(b"\n") + 1].splitlines()]


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Within, the first Ctrl-C is only remembered: whether there was one is what the value tells."""
    seen: list[int] = []

    def remember(number: int, frame: FrameType | None) -> None:
        seen.append(number)
        if len(seen) > 1:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, remember)
    try:
        yield lambda: bool(seen)
    finally:
        signal.signal(signal.SIGINT, before)


def _check_extra() -> None:
    if not all(importlib.util.find_spec(name) for name in LIBRARIES[:2]):
        raise InputError("train", "stable-baselines3", 'the extra "rl": pip install "vssm-gym[rl]"')


def _manifest(config: TrainingConfig) -> dict[str, Any]:
    world = world_hash(config.environment)
    return {
        "config": config.model_dump(mode="json"),
        "config_hash": training_hash(config, world),
        "world_hash": world,
        "version": package_version(),
        "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
    }


def _claim(out: Path, manifest: dict[str, Any], resume: bool) -> None:
    """Make ``out`` this training's folder, or say why it cannot be."""
    path = out / MANIFEST
    others = [one.name for one in out.iterdir() if not one.name.startswith((PROGRESS, f".{MANIFEST}."))]
    if others and not path.is_file():
        raise InputError(out, "folder", f"a new or empty folder, or that of a training; it holds {others[0]}")
    if any((out / name).is_file() for name in BEGUN):
        if not resume:
            raise InputError(out, "folder", "a folder without a training; --resume goes on with the one it holds")
        try:
            found = json.loads(path.read_text(encoding="utf-8"))["config_hash"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(path, "file", "the JSON that the training wrote") from error
        if found != manifest["config_hash"]:
            expected = f"{manifest['config_hash']}, as of this configuration, its map and --seed; found {found}"
            raise InputError(path, "config_hash", f"{expected}: another training belongs into another folder")
        return
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
