"""Recognise the runs of one training: policies whose labels are ``NAME@HASH`` with one NAME.

A method is what is compared: an agent, or all trained policies of one name. Its policies differ by the seed of their
training alone, which :mod:`vssm_gym.eval.metrics.resampling` resamples together with the tasks. The seeds of a sweep
are none: they draw the noise of each task anew, so that no two tasks share anything of them.
"""

import re
from collections.abc import Iterable
from typing import Any

from vssm_gym.agents.policy.policy_file import HASH_DIGITS
from vssm_gym.eval.metrics.metric import Row

RUN = "run"  # field that :func:`by_method` adds to a row: the label of the policy that drove
_LABEL = re.compile(rf"(.+)@[0-9a-f]{{{HASH_DIGITS}}}")


def training_name(agent: str) -> str | None:
    """Return NAME of an agent called ``NAME@HASH``; None of any other."""
    found = _LABEL.fullmatch(agent)
    return found[1] if found else None


def by_method(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Return rows with methods as agents: the policies of one NAME, if there are several, become ``NAME (n seeds)``.

    The label of the policy is kept as :data:`RUN`. All other rows are unchanged.
    """
    found = [dict(row) for row in rows]
    labels: dict[str, dict[str, None]] = {}
    for row in found:
        if (name := training_name(str(row["agent"]))) is not None:
            labels.setdefault(name, {})[row["agent"]] = None
    for row in found:
        name = training_name(str(row["agent"]))
        if name is not None and (runs := len(labels[name])) > 1:
            row[RUN], row["agent"] = row["agent"], f"{name} ({runs} seeds)"
    return found


def has_several(rows: Iterable[Row]) -> bool:
    """Return whether rows belong to several training runs."""
    return len(set(map(run_of, rows))) > 1


def run_of(row: Row) -> str:
    """Return the label of the policy of a row that belongs to a method of several; empty for any other."""
    return str(row.get(RUN, ""))
