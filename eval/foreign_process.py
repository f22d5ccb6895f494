"""Run a foreign library in a process of its own, which answers one line of JSON to each message.

A library that brings its own native code has a process of its own: next to JAX some have caused segmentation faults. A
process that ends early, writes nothing or writes nonsense is one :class:`InputError` that says how it ended.
"""

import contextlib
import json
import signal
import subprocess
import tempfile
from collections.abc import Sequence
from types import TracebackType
from typing import Any

from vssm_gym.errors import InputError

LEAVE_SECONDS = 30.0  # s that a process has to end after its input has


class ForeignProcess:
    """Hold the process; it ends with the ``with`` block, also after an error.

    Args:
        command: the program.
        where: what asks for it, which opens an error's message.
        field: name of the library, in the same message.
        library: the library as a sentence has it.
        unit: what is counted as done, plural.
    """

    def __init__(self, command: Sequence[str], where: str, field: str, library: str, unit: str) -> None:
        self._command, self._where, self._field = command, where, field
        self._library, self._unit, self._done = library, unit, 0

    def __enter__(self) -> "ForeignProcess":
        """Start it."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115: closed in __exit__
        self._process: Any = subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._errors
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End it."""
        try:
            if kind is None:
                self._process.stdin.close()  # its input ends, and so does it
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(LEAVE_SECONDS)
        finally:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout, self._errors):
                with contextlib.suppress(OSError):  # what was not yet sent to a dead process
                    pipe.close()

    def begin(self, message: bytes) -> dict[str, Any]:
        """Send the first message and return the answer to it.

        Raises:
            InputError: the answer holds an ``error``, or there is none.
        """
        begun = self.ask(message)
        self._done = 0
        if "error" in begun:
            raise InputError(self._where, self._field, str(begun["error"]))
        return begun

    def ask(self, message: bytes, *names: str) -> dict[str, Any]:
        """Send a message and return the answer, which holds ``names``.

        Raises:
            InputError: there is no such answer.
        """
        try:
            self._process.stdin.write(message)
            self._process.stdin.flush()
            answer = json.loads(self._process.stdout.readline())
        except (OSError, ValueError) as error:
            raise InputError(self._where, self._field, self._ending()) from error
        if not isinstance(answer, dict) or not answer.keys() >= set(names):
            raise InputError(self._where, self._field, self._ending())
        self._done += 1
        return answer

    def _ending(self) -> str:
        """Describe how the process ended, with its last line on standard error."""
        try:
            code = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            how = "gave an answer that cannot be read"
        else:
            how = f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
        self._errors.seek(0)
        said = self._errors.read().decode(errors="replace").strip().splitlines()
        last = f" ({said[-1]})" if said else ""
        return f"a process that lives to the end; {self._library}'s {how} after {self._done} {self._unit}{last}"
