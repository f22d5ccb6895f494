"""Solve by model-predictive path integrals (Williams et al., IEEE T-RO 2018), in one compiled call (eq. P30).

    eps_k = B n_k,  n_k ~ N(0, sigma^2)      w_k ∝ exp(-(C(u + eps_k) - min_j C(u + eps_j)) / lambda) [no collision]
    u <- u + sum_k w_k eps_k

Noise is drawn at a few knots and interpolated by ``B``, so that a sample is smooth. The last plan is the base
distribution (alpha = 1 there), so no further control cost enters the weights; ``C`` has its own. A sample that violates
the clearance gets no weight at all; where every sample does, the shortfall is charged instead. The average of two paths
around an obstacle can lead into it: the answer is the average only where it is allowed and cheaper than the best
sample. The first round also samples manoeuvres that the last plan does not suggest, and later rounds sample closer to
it.
"""

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.planning.clearance import ClearanceMap
from vssm_gym.planning.mpc.candidates import ProposalConfig, perturbed, propose
from vssm_gym.planning.mpc.compiled import CompiledSearch
from vssm_gym.planning.mpc.fields import Fields
from vssm_gym.planning.mpc.objective import evaluate
from vssm_gym.planning.mpc.problem import MpcProblem, MpcResult
from vssm_gym.planning.mpc.ranking import shortfall
from vssm_gym.planning.mpc.selection import Selection, select
from vssm_gym.planning.value_iteration import CostToGo


@dataclass(frozen=True)
class MppiConfig:
    """Configure samples and temperature."""

    samples: int = 256  # of each round
    rounds: int = 4
    temperature: float = 0.1  # lambda, step costs
    shrink: float = 0.5  # of the noise from one round to the next
    proposals: ProposalConfig = field(default_factory=ProposalConfig)

    def __post_init__(self) -> None:
        if not self.samples >= 2 * self.proposals.fixed:
            raise InputError("MppiConfig", "samples", f"at least {2 * self.proposals.fixed}; found {self.samples!r}")
        if not self.rounds >= 1:
            raise InputError("MppiConfig", "rounds", f"at least 1; found {self.rounds!r}")
        if not self.temperature > 0.0:
            raise InputError("MppiConfig", "temperature", f"a positive number; found {self.temperature!r}")
        if not 0.0 < self.shrink <= 1.0:
            raise InputError("MppiConfig", "shrink", f"a share in (0, 1]; found {self.shrink!r}")


class Mppi:
    """Solve by weighted averages of random drives.

    ``SOLVED``: the answer is the average; ``ACCEPTABLE``: it is a single sample.
    """

    def __init__(self, problem: MpcProblem | None = None, config: MppiConfig | None = None) -> None:
        self.problem, self.config = problem or MpcProblem(), config or MppiConfig()
        self._compiled = CompiledSearch(self.problem, self._search, self.config.rounds)

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
        problem, config = self.problem, self.config
        keys = jax.random.split(key, config.rounds)
        samples = propose(problem, config.proposals, keys[0], last, plan, config.samples)
        mean, best = self._average(fields, state, last, samples)

        def later(carry, scan):
            mean, best = carry
            key, scale = scan
            near = perturbed(problem, config.proposals, key, last, mean, config.samples - 2, scale)
            return self._average(fields, state, last, jnp.concatenate([mean[None], best[None], near])), None

        scales = jnp.asarray(config.shrink ** np.arange(1, config.rounds))
        (mean, best), _ = jax.lax.scan(later, (mean, best), (keys[1:], scales))
        selection = select(problem, fields, state, last, jnp.stack([mean, best]), 1)
        return selection, selection.chosen == 0

    def _average(
        self, fields: Fields, state: Array, last: Array, samples: Float[Array, "samples time 2"]
    ) -> tuple[Array, Array]:
        """Return ``sum_k w_k u_k`` and the best sample; limits and rates are convex, so the average keeps them."""
        plans = evaluate(self.problem, fields, state, last, samples)
        short = shortfall(self.problem, fields, state, plans)
        free = short <= self.problem.config.tolerance
        penalised = plans.cost + self.problem.config.shortfall * short
        cost = jnp.where(jnp.any(free), jnp.where(free, plans.cost, jnp.inf), penalised)
        weights = jax.nn.softmax(-cost / self.config.temperature)
        return jnp.einsum("k,ktc->tc", weights, samples), samples[jnp.argmin(cost)]
