"""Run a sample of `make fuzz`, and show that its driver sees a traceback, a refusal that costs too much, and a hang."""

from pathlib import Path
from typing import Any

import pytest

from tests.fuzz.__main__ import Tally, run
from tests.fuzz.special_cases import CHEAP, SPECIAL

SAMPLE = [*range(0, len(CHEAP), 4), *range(len(SPECIAL), len(SPECIAL) + 100)]


@pytest.mark.slow
def test_a_sample_is_read_or_refused(tmp_path: Path) -> None:
    tally = run(SAMPLE, seed=0, workers=1, out=tmp_path)
    assert not tally.failures, "\n".join(tally.failures)
    kinds = [kind for counted in tally.kinds.values() for kind in counted.elements()]
    assert len(kinds) == len(SAMPLE) and kinds.count("refused") > 50 and kinds.count("read") > 10


@pytest.mark.parametrize(
    ("changes", "failed"),
    [
        ({}, False),
        ({"kind": "read", "megabytes": 2000.0}, False),
        ({"kind": "traceback"}, True),
        ({"kind": "hang"}, True),
        ({"kind": "exit -9"}, True),
        ({"seconds": 11.0}, True),
        ({"megabytes": 1001.0}, True),
    ],
)
def test_what_counts_as_a_failure(changes: dict[str, Any], failed: bool) -> None:
    tally = Tally()
    answer = {"reader": "map", "how": "", "kind": "refused", "said": "why", "seconds": 1.0, "megabytes": 10.0}
    assert tally.add(7, answer | changes) == failed == bool(tally.failures)
    assert "map" in tally.table()
