"""Define the status of a filter's step, from inference to agents and reports."""

from enum import IntEnum


class Status(IntEnum):
    """Enumerate the outcomes of a step; reports print :attr:`message`."""

    OK = 0
    RECOVERED = 1
    LOST = 2
    NO_READING = 3

    @property
    def message(self) -> str:
        """Return the sentence for reports."""
        return _MESSAGES[self]

    @property
    def accepted(self) -> bool:
        """Return whether the image was accepted, so that the belief includes it."""
        return self in (Status.OK, Status.RECOVERED)

    def __str__(self) -> str:
        return self.message


_MESSAGES = {
    Status.OK: "ok",
    Status.RECOVERED: "found again: the image fits the map at a pose other than the expected one",
    Status.LOST: "lost track: the image does not fit what it is compared with",
    Status.NO_READING: "no depth reading, or next to none: nothing to align",
}
