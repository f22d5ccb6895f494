"""Measure collisions per metre, which does not depend on the length of a robot's path."""

from vssm_gym.eval.metrics.metric import Metric, Row


def collision_rate(row: Row) -> float | None:
    """Return ``collisions / path_length``, steps in contact per metre; None for a robot that did not move."""
    contacts, path = row.get("collisions"), row.get("path_length")
    if contacts is None or not path:
        return None
    return contacts / path


COLLISION_RATE = Metric(collision_rate, "collisions / m", 2, "lower", ("navigation", "explore"))
