"""Hold a running training of any algorithm: its clock, its limits, its log, and its policy file."""

import contextlib
import json
import math
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from vssm_gym.agents.policy.policy_file import Policy, PolicySpec, load, save
from vssm_gym.errors import InputError
from vssm_gym.files.bounded import read_bytes
from vssm_gym.files.json_file import parse_json_lines
from vssm_gym.files.line_file import LineFile
from vssm_gym.training.config import TrainingConfig
from vssm_gym.training.environment import BODY

POLICY = "policy.npz"
PROGRESS_BYTES = 64 << 20  # a row every five seconds for 20 days
ROW_SECONDS, CHECKPOINT_SECONDS = 5.0, 60.0  # s between lines of the log, and between checkpoints

WINDOW = 500  # episodes that means are taken over
LEAST_RATE = 0.05  # fraction of the learning rate at the end
ENOUGH_EPISODES = 100  # that means are taken over before they are shown: success is then known to 0.05 (one std)

# Of progress.jsonl: seconds, of those preparing, steps, episodes, return, length, success, and whether they are enough
Row = dict[str, Any]
OnUpdate = Callable[[Row, float], None]  # a row, and the fraction of the training that is done


@dataclass(frozen=True)
class TrainingProgress:
    """Hold the progress of a training.

    Attributes:
        steps: of all robots together.
        episodes: number of episodes in the means, at most WINDOW; the means are None without any.
        mean_return: of an episode.
        mean_length: of an episode, steps.
        success: proportion of successful episodes.
    """

    steps: int
    episodes: int
    mean_return: float | None
    mean_length: float | None
    success: float | None


class Run:
    """Hold a running training: its clock, its limits, and its files."""

    def __init__(
        self,
        config: TrainingConfig,
        out: Path,
        manifest: dict[str, Any],
        log: "ProgressLog",
        interrupted: Callable[[], bool],
        on_update: OnUpdate,
    ) -> None:
        self.config, self.out = config, out
        self._manifest, self._log, self._on_update = manifest, log, on_update
        self.interrupted = interrupted
        self.steps = 0  # of all robots together
        self.preparing = 0.0  # s of building and compiling, in all sessions
        self._began = self._session_began = time.monotonic()
        self._session_steps, self._stepped = 0, False
        self._row_at = self._kept_at = 0.0

    @property
    def policy_file(self) -> Path:
        """Return the file of :meth:`write_policy`."""
        return self.out / POLICY

    @property
    def seconds(self) -> float:
        """Return the seconds trained so far, those of earlier sessions included."""
        return time.monotonic() - self._began

    def begin(self) -> None:
        """Start from the beginning; drop the log of a training that was killed before its first checkpoint."""
        self._log.drop_after(-1)

    def resume(self, steps: int, seconds: float) -> None:
        """Continue from a checkpoint; drop what was logged after it."""
        self.steps = self._session_steps = steps
        self._began -= seconds
        self._row_at = self._kept_at = self.seconds
        kept = self._log.drop_after(steps)
        self.preparing += kept[-1].get("preparing", 0.0) if kept else 0.0

    def stepped(self) -> None:
        """Note that all robots have stepped; before the first time, they were built and their step was compiled."""
        if not self._stepped:
            self.preparing += time.monotonic() - self._session_began
            self._stepped = True

    def fraction_done(self) -> float:
        """Return the fraction of the training that is done, in [0, 1]."""
        minutes = self.config.minutes
        return min(1.0, max(self.steps / self.config.steps, self.seconds / (60.0 * minutes) if minutes else 0.0))

    def finished(self) -> bool:
        """Return whether an earlier session has ended the training; of its files the policy is written last."""
        if not self.policy_file.is_file():
            return False
        trained, minutes = load(self.policy_file).spec.trained, self.config.minutes
        late = minutes is not None and trained["seconds"] >= round(60.0 * minutes, 1)
        return late or trained["steps"] >= self.config.steps

    def over(self) -> bool:
        """Return True to end now: interrupted, or out of time."""
        minutes = self.config.minutes
        return self.interrupted() or (minutes is not None and self.seconds >= 60.0 * minutes)

    def report(self, row: Row, keep: Callable[[], None]) -> None:
        """Log an update, report it once the robots have stepped, and sometimes call ``keep()``: write a checkpoint."""
        row = self._completed(row)
        if self._stepped:
            self._on_update(row, self.fraction_done())
        due = self.seconds - self._kept_at >= CHECKPOINT_SECONDS
        if due or self.seconds - self._row_at >= ROW_SECONDS:
            self._log.append(row)
            self._row_at = self.seconds
        if due:
            keep()
            self._kept_at = self.seconds

    def end(self, row: Row, keep: Callable[[], None]) -> None:
        """Write the last row and the last checkpoint of this session."""
        row = self._completed(row)
        self._log.append(row)
        keep()
        self._on_update(row, self.fraction_done())

    def check(self, numbers: Iterable[Any]) -> None:
        """Raise :meth:`diverged` unless all numbers and arrays are finite."""
        if not all(np.isfinite(one).all() for one in numbers):
            raise self.diverged()

    def diverged(self) -> InputError:
        """Return the error of a training that is of no more use; what it kept before stays."""
        rate = self.config.algorithm.learning_rate
        expected = f"less than {rate:g}, with which the training diverged at step {self.steps:,}"
        return InputError("train", "algorithm.learning_rate", expected)

    def _completed(self, row: Row) -> Row:
        """Complete a row with the clock, and with whether its means are over enough episodes of this session.

        In its first steps only short episodes have ended, and nearly all of those succeeded.
        """
        self.steps = row["steps"]
        self.check(value for value in row.values() if isinstance(value, float))
        whole_round = self.steps - self._session_steps >= first_round(self.config)
        enough = row["success"] is not None and row["episodes"] >= ENOUGH_EPISODES and whole_round
        clock = {"seconds": round(self.seconds, 4), "preparing": round(self.preparing, 4)}
        return {**clock, **row, "enough": enough}

    def write_policy(self, layers: tuple[tuple[np.ndarray, np.ndarray], ...], squash: str) -> None:
        """Write the present network to ``policy.npz``."""
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


class ProgressLog:
    """Write ``progress.jsonl``, in a folder that the process owns."""

    def __init__(self, path: Path) -> None:
        self._path, self._file = path, LineFile(path)

    def append(self, row: Row) -> None:
        """Add a line."""
        self._file.append(json.dumps(row, allow_nan=False).encode() + b"\n", sync=True)

    def drop_after(self, steps: int) -> list[Row]:
        """Drop lines after ``steps``, and an unfinished last line; return the others, which are not written again."""
        kept = [row for row in read_progress(self._path) if row["steps"] <= steps]  # the first ones: steps only grow
        self._file.truncate(sum(map(len, self._path.read_bytes().splitlines(keepends=True)[: len(kept)])))
        return kept

    def __enter__(self) -> "ProgressLog":
        return self

    def __exit__(self, *exception: object) -> None:
        self._file.close()


def falling_rate(first: float, done: float) -> float:
    """Return the learning rate when a fraction ``done`` of the training is over: it falls linearly to LEAST_RATE."""
    return first * max(LEAST_RATE, 1.0 - done)


def first_round(config: TrainingConfig) -> int:
    """Return the steps of all robots together after which each has had the time for a whole episode."""
    return config.environment.num_envs * config.environment.max_episode_steps


def read_progress(path: Path) -> list[Row]:
    """Read the lines of a ``progress.jsonl``; an unfinished last one is left out.

    Raises:
        InputError: no such file, or a line that is no row of progress: JSON with numbers as ``seconds`` and ``steps``,
            which never fall, and as ``success`` and ``return``, which are null where no episode has ended.
    """
    data = read_bytes(path, PROGRESS_BYTES, "the progress of a training; `vssm-gym train` writes it")
    rows: list[Row] = []
    for number, row in parse_json_lines(data[: data.rfind(b"\n") + 1], path, "a row of progress"):
        if not all(_is_number(row.get(key)) for key in ("seconds", "steps")):
            raise InputError(path, f"line {number}", "numbers as seconds and steps")
        unknown = row.get("success") is None and row.get("return") is None
        if not unknown and not (_is_number(row.get("return")) and _is_number(row.get("success"))):
            raise InputError(path, f"line {number}", "numbers as success and return, or null as both")
        if not _is_number(row.get("preparing", 0.0)):
            raise InputError(path, f"line {number}", "a number as preparing")
        if rows and (row["seconds"] < rows[-1]["seconds"] or row["steps"] < rows[-1]["steps"]):
            raise InputError(path, f"line {number}", "seconds and steps that do not fall")
        rows.append({"success": None, "return": None, **row})
    return rows


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@contextlib.contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Defer the first Ctrl-C, in a command also SIGTERM; the value is a function that returns whether there was one."""
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
