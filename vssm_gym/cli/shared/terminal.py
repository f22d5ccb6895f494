"""Take over the terminal: read single keys, draw on the alternate screen, and restore everything at the end.

It uses POSIX termios and common escape sequences, and works over SSH.
"""

import contextlib
import os
import select
import signal
import sys
import termios
import tty
from collections.abc import Iterator, Sequence
from typing import Any

from vssm_gym.errors import InputError

# The alternate screen, without a cursor and without wrapping; and back.
ENTER, LEAVE = "\x1b[?1049h\x1b[?25l\x1b[?7l\x1b[2J", "\x1b[?7h\x1b[?25h\x1b[0m\x1b[?1049l"
RESIZE_POLL = 0.2  # s between two checks of the size while no key is pressed
ESCAPE_WAIT = 0.05  # s within which the rest of an arrow key's sequence follows its escape
_ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
_NAMES = {" ": "space", "\x1b": "escape"}


class Terminal:
    """Draw frames and read keys; made by :func:`whole_terminal`."""

    def __init__(self, source: int, target: int) -> None:
        self._source, self._target = source, target
        self._bytes = b""
        self._shown: list[str] = []
        self._size = (0, 0)

    @property
    def size(self) -> tuple[int, int]:
        """Return the current columns and rows; 80 x 24 if the terminal does not report them."""
        columns, rows = os.get_terminal_size(self._target)
        return columns or 80, rows or 24

    def draw(self, lines: Sequence[str]) -> None:
        """Draw ``lines`` from the upper left corner; only changed ones are sent."""
        size = self.size
        lines = list(lines)[: size[1]]
        text = ""
        if size != self._size:
            text, self._shown, self._size = "\x1b[2J", [], size
        shown = self._shown + [""] * (len(lines) - len(self._shown))
        for row, line in enumerate(lines):
            if line != shown[row]:
                text += f"\x1b[{row + 1};1H{line}\x1b[0m\x1b[K"
        if len(lines) < len(self._shown):
            text += f"\x1b[{len(lines) + 1};1H\x1b[J"
        self._shown = lines
        data = text.encode()
        while data:
            data = data[os.write(self._target, data) :]

    def pressed(self) -> list[str]:
        """Return the keys pressed since the last call; wait for one, or until the terminal is resized (then none).

        A key is its character in lower case, or ``up``, ``down``, ``left``, ``right``, ``space``, ``escape``. The end
        of the input, as when a connection breaks, ends the program as Ctrl-C does.
        """
        while not self._ready(RESIZE_POLL):
            if self.size != self._size:
                return []
        self._receive()
        while self._bytes.endswith((b"\x1b", b"\x1b[", b"\x1bO")) and self._ready(ESCAPE_WAIT):
            self._receive()
        text, self._bytes = self._bytes.decode("utf-8", "replace"), b""
        return split_keys(text)

    def _ready(self, timeout: float) -> bool:
        return bool(select.select([self._source], [], [], timeout)[0])

    def _receive(self) -> None:
        received = os.read(self._source, 1024)
        if not received:
            raise KeyboardInterrupt
        self._bytes += received


def split_keys(text: str) -> list[str]:
    """Return the names of typed keys; escape sequences of keys without a name here are dropped."""
    keys, i = [], 0
    while i < len(text):
        if text[i] == "\x1b" and text[i + 1 : i + 2] in ("[", "O"):
            end = i + 2
            while end < len(text) and not "@" <= text[end] <= "~":
                end += 1
            if name := _ARROWS.get(text[end : end + 1]):
                keys.append(name)
            i = end + 1
            continue
        keys.append(_NAMES.get(text[i], text[i].lower()))
        i += 1
    return keys


def check_terminal(command: str) -> None:
    """Raise :class:`InputError` unless stdin and stdout are a terminal."""
    for name, stream in (("stdin", sys.stdin), ("stdout", sys.stdout)):
        if not stream.isatty():
            raise InputError(command, name, "a terminal")


@contextlib.contextmanager
def whole_terminal() -> Iterator[Terminal]:
    """Yield the terminal of stdin and stdout, and restore it however the block ends.

    Ctrl-C raises KeyboardInterrupt as usual; SIGTERM and SIGHUP leave the block too. Ctrl-Z is disabled: a stopped
    program could not restore the terminal.
    """
    source, target = sys.stdin.fileno(), sys.stdout.fileno()
    before = termios.tcgetattr(source)
    handlers: dict[int, Any] = {}
    try:
        for number in (int(signal.SIGTERM), int(signal.SIGHUP)):
            handlers[number] = signal.signal(number, _leave)
        tty.setcbreak(source)
        changed = termios.tcgetattr(source)
        changed[6][termios.VSUSP] = bytes([os.fpathconf(source, "PC_VDISABLE")])
        termios.tcsetattr(source, termios.TCSANOW, changed)
        os.write(target, ENTER.encode())
        yield Terminal(source, target)
    finally:
        with contextlib.suppress(OSError):  # the terminal itself may be gone
            os.write(target, LEAVE.encode())
        with contextlib.suppress(termios.error):
            termios.tcsetattr(source, termios.TCSAFLUSH, before)
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _leave(number: int, frame: Any) -> None:
    raise SystemExit(128 + number)
