"""Solve by random search and an augmented Lagrangian (thesis, section 5.6.1), in one compiled call (eq. P29).

U = the M best of K candidates by C(u) + w max_i max(0, m - g_i(u));   u = the best of U and refine(U)
"""

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from vssm_gym.errors import InputError
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc.candidates import ProposalConfig, propose
from vssm_gym.planning.mpc.compiled import CompiledSearch
from vssm_gym.planning.mpc.fields import Fields
from vssm_gym.planning.mpc.lagrangian import RefineConfig, refine
from vssm_gym.planning.mpc.objective import required_clearance
from vssm_gym.planning.mpc.problem import MpcProblem, MpcResult
from vssm_gym.planning.mpc.ranking import ranked
from vssm_gym.planning.mpc.selection import Selection, select
from vssm_gym.planning.value_iteration import CostToGo


@dataclass(frozen=True)
class RandomSearchConfig:
    """Configure the effort of the search."""

    candidates: int = 512  # K
    refined: int = 8  # M
    refine: RefineConfig = field(default_factory=RefineConfig)
    proposals: ProposalConfig = field(default_factory=ProposalConfig)

    def __post_init__(self) -> None:
        least = 2 * self.proposals.fixed
        if not self.candidates >= least:
            raise InputError("RandomSearchConfig", "candidates", f"at least {least}; found {self.candidates!r}")
        if not 1 <= self.refined <= self.candidates:
            raise InputError("RandomSearchConfig", "refined", f"from 1 to {self.candidates}; found {self.refined!r}")


class RandomSearch:
    """Solve globally by random candidates, locally by gradients.

    ``SOLVED``: the answer is a refined plan; ``ACCEPTABLE``: it is a candidate as drawn.
    """

    def __init__(self, problem: MpcProblem | None = None, config: RandomSearchConfig | None = None) -> None:
        self.problem, self.config = problem or MpcProblem(), config or RandomSearchConfig()
        self._compiled = CompiledSearch(self.problem, self._search, self.config.refine.iterations)

    def plan(
        self,
        state: np.ndarray,
        value: CostToGo,
        clearance: ClearanceMap,
        warm: MpcResult | None = None,
        control: np.ndarray | None = None,
    ) -> MpcResult:
        """See :meth:`~vssm_gym.planning.mpc.problem.MpcSolver.plan`."""
        return self._compiled.plan(state, value, clearance, warm, control)

    def _search(self, fields: Fields, state: Array, last: Array, plan: Array, key: Array) -> tuple[Selection, Array]:
        candidates = propose(self.problem, self.config.proposals, key, last, plan, self.config.candidates)
        best, _ = ranked(self.problem, fields, state, last, candidates, self.config.refined)
        # After a step with noise the last plan may miss the margin by a millimetre: it is repaired, never dropped.
        best = best.at[-1].set(candidates[0])
        least = required_clearance(self.problem, fields, state)
        refined = refine(self.problem, self.config.refine, fields, state, last, least, best)
        selection = select(self.problem, fields, state, last, jnp.concatenate([refined, best]), self.config.refined)
        return selection, selection.chosen < self.config.refined
