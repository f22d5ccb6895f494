"""State what the plane's planners, explorers and filters ask of a model: scans under ``q(M)``, whatever the map is."""

from typing import Protocol, runtime_checkable

from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.model.scanner import Scanner


@runtime_checkable
class ScanModel(Protocol):
    """Describe ``p(x | z, M)`` of a laser scan and ``q(M)``; an implementation is a pytree.

    States are poses of the robot: x, y (m), heading (rad). A range of 0 is no reading.
    """

    @property
    def scanner(self) -> Scanner:
        """Return the scanner on the robot."""

    def ranges(self, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Return the ranges that the map's mean predicts, m, without the sensor's noise; never 0.

        Where it predicts no surface within the scanner's range they are that range.
        """

    def log_prob(self, ranges: Float[Array, "beams"], state: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
        """Return ``log p(x | z, M)`` of a scan at the map's mean, nats; readings of 0 say nothing."""

    def sample(self, key: PRNGKeyArray, state: Float[Array, "*batch 3"]) -> Float[Array, "*batch beams"]:
        """Draw scans ``x ~ p(x | z, M)`` at the map's mean."""

    def draw_map(self, key: PRNGKeyArray) -> "ScanModel":
        """Return this model with a map drawn from ``q(M)``, as its mean."""
