"""Check that the tests notice plausible errors in the scientific core.

    python -m tests.mutants [--only NAME ...] [--workers 2]

Each mutant of the catalogue is applied to a copy of the checkout, in which its tests run; one of them must fail. A line
is printed for each as it ends. The exit code is 1 where fewer than 90 % are caught, where a mutant does not apply to
the source any more, or where tests fail without a mutant.
"""

import argparse
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from tests.helpers.paths import CHECKOUT
from tests.mutants.catalogue import MUTANTS
from tests.mutants.mutant import Mutant
from tests.mutants.runner import outcomes

SHARE = 0.9  # of the mutants that must be caught


def check(mutants: Sequence[Mutant], checkout: Path, workers: int) -> int:
    """Try the mutants, print a table, and return the exit code."""
    began, verdicts = time.monotonic(), Counter[str]()
    with tempfile.TemporaryDirectory(prefix="mutants-") as scratch:
        for one in outcomes(mutants, checkout, Path(scratch), workers):
            verdicts[one.verdict] += 1
            say(f"{one.verdict:>7}  {one.seconds:4.0f} s  {one.name}{': ' if one.detail else ''}{one.detail}")
    minutes = (time.monotonic() - began) / 60.0
    counts = ", ".join(f"{verdicts[verdict]} {verdict}" for verdict in ("caught", "missed", "stale", "broken"))
    say(f"{len(mutants)} mutants in {minutes:.1f} min: {counts}")
    return exit_code(verdicts)


def exit_code(verdicts: Counter[str]) -> int:
    """Return 1 where too few mutants are caught, where one is stale, or where tests have no verdict."""
    caught, missed = verdicts["caught"], verdicts["missed"]
    return int(bool(verdicts["stale"] + verdicts["broken"]) or caught < SHARE * (caught + missed))


def main(arguments: list[str]) -> int:
    """Try the mutants that the arguments name, all by default; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    names = [mutant.name for mutant in MUTANTS]
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME", help=", ".join(names))
    parser.add_argument("--workers", type=int, default=2, help="mutants at once")
    options = parser.parse_args(arguments)
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # as Ctrl-C: end the tests, tidy up
    return check(tuple(m for m in MUTANTS if m.name in options.only), CHECKOUT, options.workers)


def say(text: str) -> None:
    """Print at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
