"""Define the errors that the command line prints as one line, of invalid input and of output, and what they say."""

import difflib
import re
from collections.abc import Iterable

LONGEST_VALUE = 200  # characters of a quoted name or value
LONGEST_MESSAGE = 2000  # characters of each of the three parts of a message


class InputError(ValueError):
    """Report invalid input: ``source`` (a file or argument), ``field`` within it, and what was ``expected``.

    The command line prints its message alone, without a traceback. The message is one line of printable characters;
    a word of more than ``LONGEST_VALUE`` characters is shortened, for it may come from a file.
    """

    def __init__(self, source: object, field: str, expected: str) -> None:
        self.source, self.field, self.expected = _printable(str(source)), _printable(field), _printable(expected)
        super().__init__(f"{self.source}: {self.field}: expected {self.expected}")

    def __reduce__(self) -> tuple[type["InputError"], tuple[str, str, str]]:
        """Pickle by the three arguments, not by the message made of them, for errors of worker processes."""
        return type(self), (self.source, self.field, self.expected)


class OutputError(OSError):
    """Report a file or folder that could not be written, and the ``reason``: a full disk, a quota, no permission.

    The command line prints its message alone, without a traceback.
    """

    def __init__(self, path: object, reason: str) -> None:
        self.path, self.reason = _printable(str(path)), reason
        super().__init__(f"{self.path}: could not be written: {reason}")

    def __reduce__(self) -> tuple[type["OutputError"], tuple[str, str]]:
        """Pickle by the two arguments, not by the message made of them, for errors of worker processes."""
        return type(self), (self.path, self.reason)


def one_of(available: Iterable[str], found: object) -> str:
    """Return what was expected of a name: "one of oak, elm; found 'oka' (did you mean 'oak'?)"."""
    available = tuple(available)
    return f"one of {', '.join(available)}; found {found!r:.80}{did_you_mean(available, found)}"


def did_you_mean(available: Iterable[str], found: object) -> str:
    """Return " (did you mean 'oak'?)" where one of the names is much like what was found, else nothing."""
    if not isinstance(found, str):
        return ""
    alike = difflib.get_close_matches(found[:LONGEST_VALUE], available, n=1)
    return f" (did you mean {alike[0]!r}?)" if alike else ""


def _printable(text: str) -> str:
    """Return the text with control characters escaped, long words and a long whole shortened."""
    text = "".join(
        c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in text[:10_000]
    )
    text = re.sub(rf"\S{{{LONGEST_VALUE + 1},}}", lambda word: f"{word[0][: LONGEST_VALUE - 3]}...", text)
    return text if len(text) <= LONGEST_MESSAGE else f"{text[: LONGEST_MESSAGE - 3]}..."
