"""Build the car's tables: the metrics of its episodes, and its two simulators side by side."""

from collections.abc import Sequence

from vssm_gym.eval.metrics import aggregate
from vssm_gym.eval.metrics.metric import Row
from vssm_gym.eval.report.tables import Measures, grouping
from vssm_gym.viz.html import Table

CAR = Measures("car")
SIMULATORS = ("mujoco", "bullet")


def pooled(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the headline's groups: the conditions without scenes and simulators, which it pools."""
    return tuple(name for name in grouping(rows) if name not in ("scene", "physics"))


def simulators(rows: Sequence[Row], seed: int) -> Table | None:
    """Tabulate each agent's metrics in both simulators and their paired difference; None where one did not run.

    Agents plan on the bicycle's kinematics in both; both run the same targets and seeds.
    """
    first, second = SIMULATORS
    by, names = pooled(rows), [CAR.label(metric) for metric in CAR.compared]
    lines = []
    for group, members in aggregate.group_rows(rows, by).items():
        of = aggregate.group_rows(members, ["physics"])
        if not {(first,), (second,)} <= of.keys():
            continue
        for name in SIMULATORS:
            ran = of[name,]
            lines.append([*group, name, str(len(ran)), *(CAR.mean(ran, metric, seed) for metric in CAR.compared)])
        found = {m: CAR.difference(members, m, second, first, seed, "physics") for m in CAR.compared}
        pairs = max((interval.episodes for interval in found.values() if interval), default=0)
        cells = [CAR.text(metric, interval) for metric, interval in found.items()]
        lines.append([*group, f"{second} - {first}", str(pairs), *cells])
    header = [*(name.replace("_", " ") for name in by), "executed in", "episodes", *names]
    return Table(header, lines, len(by) + 1) if lines else None
