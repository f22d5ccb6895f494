"""Hold the weights of the dense rewards.

    reward = gain * gained - step_cost - collision_cost [in collision] + success [arrived]

``gained`` is progress in the step: metres of path to the goal, or a share of what can be seen. Each environment defines
its own weights in its module.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class DenseReward:
    """Weigh what happens in a step.

    Args:
        step_cost: cost of every step.
        success: reward of arriving; the sparse reward consists of it alone.
        gain: reward of a unit of progress: 1 for a metre, so that all other weights are in metres.
        collision_cost: cost of a step in which an obstacle is hit.
        alignment: m that a radian of heading error adds to the distance from a target pose.
    """

    step_cost: float
    success: float = 0.0
    gain: float = 1.0
    collision_cost: float = 0.0
    alignment: float = 0.0
