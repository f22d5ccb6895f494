"""End an interrupted command with one line: what it keeps, and the command that continues or repeats it."""

import contextlib
import functools
import inspect
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


AGAIN_SECONDS = 0.1  # after which a callback that has swallowed an interruption has ended


class Interrupted(KeyboardInterrupt):
    """Report an interruption; the message says what is kept and how to go on."""


def interruptible(*kept: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorate a command with ``out``: when it is interrupted it raises :class:`Interrupted` with a message.

    A message that the command itself has raised stays.

    Args:
        kept: patterns of the files under ``out`` that an interrupted run leaves for its user or for ``--resume``.
    """

    def decorate(command: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(command)
        resumes = "resume" in signature.parameters

        @functools.wraps(command)
        def run(*args: P.args, **kwargs: P.kwargs) -> R:
            try:
                return command(*args, **kwargs)
            except Interrupted:  # the command has said what it keeps
                raise
            except KeyboardInterrupt:
                given = signature.bind(*args, **kwargs)
                given.apply_defaults()
                raise Interrupted(advice(given.arguments["out"], kept, resumes, sys.argv[1:])) from None

        return run

    return decorate


def advice(out: Path, kept: tuple[str, ...], resumes: bool, arguments: list[str]) -> str:
    """Return what an interrupted command keeps, and the command line to continue it.

    Args:
        out: its output.
        kept: patterns of files under ``out``.
        resumes: whether ``--resume`` continues it; the same command repeats another one.
        arguments: of the interrupted command line.
    """
    found = [word for pattern in kept if (word := _found(out, pattern))]
    what = f"{out} keeps {', '.join(found)}" if found else "no result of this run is kept"
    again = shlex.join(["vssm-gym", *arguments, *(["--resume"] if resumes and "--resume" not in arguments else [])])
    return f"{what}; {'continue' if resumes and found else 'start it again'} with: {again}"


def _found(out: Path, pattern: str) -> str:
    """Return the files with content that match, in words: the name of one, the number of several."""
    shown = [path for path in sorted(out.glob(pattern)) if not path.name.startswith(".")]
    paths = [path for path in shown if path.is_dir() or path.stat().st_size > 0]
    if len(paths) != 1:
        return f"{len(paths)} of {pattern}" if paths else ""
    name = str(paths[0].relative_to(out))
    if paths[0].suffix not in (".jsonl", ".txt"):
        return name
    count = paths[0].read_bytes().count(b"\n")
    return f"{name} ({count} line{'s' * (count != 1)})"


@contextlib.contextmanager
def termination_as_interrupt() -> Iterator[Callable[[], int]]:
    """Let SIGTERM do what Ctrl-C does; the value is a function that returns the exit code of an interruption.

    The code is what shells report: 128 and the number of the signal. A shell starts a background job with Ctrl-C
    ignored; SIGTERM interrupts that one too. An interruption that falls into a callback whose exceptions Python
    ignores, such as a destructor or one of JAX's garbage collection, comes again after it.
    """
    received = [signal.SIGINT]

    def interrupt(number: int, frame: FrameType | None) -> None:
        received.append(signal.SIGTERM)
        handler = signal.getsignal(signal.SIGINT)  # that of a training lets the present update end
        (handler if callable(handler) else signal.default_int_handler)(number, frame)

    def come_again(ignored: "sys.UnraisableHookArgs") -> None:
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            again = threading.Timer(AGAIN_SECONDS, lambda: os.kill(os.getpid(), received[-1]))
            again.daemon = True
            again.start()
        else:
            hook(ignored)

    before, hook = signal.signal(signal.SIGTERM, interrupt), sys.unraisablehook
    sys.unraisablehook = come_again
    try:
        yield lambda: 128 + received[-1]
    finally:
        sys.unraisablehook = hook
        signal.signal(signal.SIGTERM, before)
