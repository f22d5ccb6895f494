"""Define the status of a filter's step, from inference to agents and reports."""

from enum import IntEnum


class Status(IntEnum):
    """Enumerate the outcomes of a step; reports print :attr:`message`.

    Filters report the first five and the last; the others are what agents conclude from several steps.
    """

    OK = 0
    RECOVERED = 1
    LOST = 2
    NO_READING = 3
    REPEATED = 4
    FROZEN = 5
    UNCONFIRMED = 6
    OVERSHOOT = 7
    TURNED = 8

    @property
    def message(self) -> str:
        """Return the sentence for reports."""
        return _MESSAGES[self]

    @property
    def accepted(self) -> bool:
        """Return True if the image was accepted, so that the belief includes it and may be used."""
        return self in (Status.OK, Status.RECOVERED, Status.TURNED)

    def __str__(self) -> str:
        return self.message


_MESSAGES = {
    Status.OK: "ok",
    Status.RECOVERED: "relocalised: the image fits the map at a pose other than the expected one",
    Status.LOST: "lost track: the image does not fit the reference view",
    Status.NO_READING: "no depth: too few pixels have a depth reading to align the image",
    Status.REPEATED: "repeated image: the camera is frozen, or an obstacle holds the robot",
    Status.FROZEN: "frozen images: they repeat although the robot was commanded to turn",
    Status.UNCONFIRMED: "not confirmed: the image fits, but too few have since the robot was lost",
    Status.TURNED: "turned: the image fits nothing, but its colours show how the camera has turned",
    Status.OVERSHOOT: "the images show more motion than was commanded: the scale of the depth is wrong",
}
