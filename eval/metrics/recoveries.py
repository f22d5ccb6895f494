"""Count the responses to failures on the way, of all kinds, in an episode."""

from vssm_gym.eval.metrics.metric import Metric, Row


def recoveries(row: Row) -> float | None:
    """Return ``sum of responses``; None of an agent that does not count them."""
    responses = row.get("responses")
    return None if responses is None else float(sum(responses.values()))


RECOVERIES = Metric(recoveries, "recoveries", 2, "lower", ("navigation",))
