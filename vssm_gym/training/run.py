"""One training under way: its clock, its limits, its log, and what it writes; whichever algorithm it is."""

import contextlib
import fcntl
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from vssm_gym.agents.policy.policy_file import Policy, PolicySpec, save
from vssm_gym.errors import InputError
from vssm_gym.training.config import TrainingConfig
from vssm_gym.training.environment import BODY

POLICY = "policy.npz"
ROW_SECONDS, CHECKPOINT_SECONDS = 5.0, 60.0

Row = dict[str, Any]  # of progress.jsonl: seconds, steps, episodes, return, length, success
Told = Callable[[Row, float], None]  # a row, and the share of the training that is done


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
