"""A whole terminal for one program: keys as they are pressed, a screen of its own, and everything put back at the end.

Plain POSIX (termios) and escape sequences that every terminal of the last decades knows; works over SSH.
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
RESIZE_POLL = 0.2  # s between two looks at the size while nobody presses a key
ESCAPE_WAIT = 0.05  # s within which the rest of an arrow key's sequence follows its escape
_ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
_NAMES = {" ": "space", "\x1b": "escape"}


class Terminal:
    """Draws frames and reads keys; made by :func:`whole_terminal`."""

    def __init__(self, source: int, target: int) -> None:
        self._source, self._target = source, target
        self._bytes = b""
        self._shown: list[str] = []
        self._size = (0, 0)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows, as they are now; 80 x 24 where the terminal does not say."""
        columns, rows = os.get_terminal_size(self._target)
        return columns or 80, rows or 24

    def draw(self, lines: Sequence[str]) -> None:
        """Show ``lines`` from the upper left corner; only those that changed are sent."""
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
        """The keys pressed since the last call; waits for one, or until the terminal has another size (then none).

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
    """What was typed, as names of keys; sequences of keys that have no name here are left out."""
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
            raise InputError(command, name, "a terminal: a person presses keys and looks at pictures here")


@contextlib.contextmanager
def whole_terminal() -> Iterator[Terminal]:
    """The terminal that stdin and stdout are; it is as before when the block ends, however it ends.

    Ctrl-C raises KeyboardInterrupt as always; a request to end (SIGTERM, SIGHUP) leaves the block too. Ctrl-Z does
    nothing: a stopped program would leave the terminal as it has it.
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
