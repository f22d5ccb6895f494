"""Make policies of known paths."""

import numpy as np

from vssm_gym.agents.policy.policy_file import Policy, PolicySpec
from vssm_gym.training.environment import BODY


def straight(step: float = 1.0) -> Policy:
    """Turn towards the goal and drive at full speed (``step`` = -1: not at all).

    Its input is the bearing's cosine and sine, and two lengths.
    """
    spec = PolicySpec(
        name="straight",
        parts=("goal",),
        frames=1,
        hidden=(),
        activation="tanh",
        squash="clip",
        low=tuple(BODY.low.tolist()),
        high=tuple(BODY.high.tolist()),
        max_depth=BODY.max_depth,
        hfov=BODY.hfov,
        success_radius=BODY.success_radius,
    )
    weight = np.zeros((3, 4), np.float32)
    weight[0, 1] = 5.0
    return Policy(spec, ((weight, np.array([0.0, 0.0, step], np.float32)),))
