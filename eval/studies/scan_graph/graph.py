"""Hold a graph of planar poses, which a process of its own optimises.

The program is :mod:`vssm_gym.eval.studies.scan_graph.gtsam_program`, whose documentation defines the messages.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.eval.foreign_process import ForeignProcess

GTSAM_COMMAND = (sys.executable, "-m", "vssm_gym.eval.studies.scan_graph.gtsam_program")
UPPER = np.triu_indices(3)  # row and column of each number of a symmetric matrix that is sent


@dataclass(frozen=True)
class Factor:
    """Hold a relation of two nodes.

    Attributes:
        a: number of the node that it is seen from.
        b: number of the node seen.
        motion: pose of b in the frame of a.
        covariance: of its error in the frame of b (forward, left, turn).
        robust: whether it may be wrong.
    """

    a: int
    b: int
    motion: Float[np.ndarray, "3"]
    covariance: Float[np.ndarray, "3 3"]
    robust: bool = False


class PoseGraph:
    """Hold the nodes' poses beside the process, which ends with the ``with`` block.

    Args:
        where: what asks for it, which opens an error's message.
        command: the program.
    """

    def __init__(self, where: str, command: Sequence[str] = GTSAM_COMMAND) -> None:
        self._process = ForeignProcess(command, where, "gtsam", "GTSAM", "requests")
        self.poses: Float[np.ndarray, "nodes 3"] = np.zeros((0, 3))
        self.version = ""

    def __enter__(self) -> "PoseGraph":
        """Start the process.

        Raises:
            InputError: GTSAM is not installed.
        """
        self._process.__enter__()
        try:
            self.version = str(self._process.begin(b"{}\n").get("version", ""))
        except BaseException:
            self._process.__exit__(*sys.exc_info())
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End it."""
        self._process.__exit__(kind, error, trace)

    def add(self, pose: Float[np.ndarray, "3"], factors: Sequence[Factor] = ()) -> int:
        """Add a node with its factors and return its number."""
        self.poses = np.concatenate([self.poses, np.asarray(pose, float)[None]])
        self._ask(poses=[list(map(float, pose))], factors=[_row(factor) for factor in factors])
        return len(self.poses) - 1

    def connect(self, factors: Sequence[Factor], clear: bool = False) -> None:
        """Add factors, all others being dropped where ``clear``."""
        self._ask(factors=[_row(factor) for factor in factors], clear=clear)

    def solve(self) -> None:
        """Optimise all poses."""
        self.poses = np.array(self._ask("poses", solve=True)["poses"]).reshape(-1, 3)

    def covariances(self, pairs: Sequence[tuple[int, int]]) -> Float[np.ndarray, "pairs 3 3"]:
        """Return the covariance of the error of the second of each pair, as seen from the first."""
        if not pairs:
            return np.zeros((0, 3, 3))
        return np.array(self._ask("covariances", pairs=list(pairs))["covariances"]).reshape(-1, 3, 3)

    def _ask(self, *names: str, **request: Any) -> dict[str, Any]:
        return self._process.ask(json.dumps(request).encode() + b"\n", *names)


def _row(factor: Factor) -> list[Any]:
    numbers = [*factor.motion.tolist(), *np.asarray(factor.covariance)[UPPER].tolist()]
    return [factor.a, factor.b, *numbers, int(factor.robust)]
