"""Define the protocol of an agent: ``reset(context, observation, seed)``, then ``act(observation) -> Decision``.

An agent sees its observations, remembers its own commands, and knows a static :class:`AgentContext`. It holds no
reference to the environment and never receives ``info``, so that no ground truth can reach it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np

from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import DirectionFrame
from vssm_gym.geometry.car import Car
from vssm_gym.inference.scan_encoder.network import ScanEncoder
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.transition.base import Transition

Observation: TypeAlias = Mapping[str, np.ndarray]

ANY_TASK = "any"  # of an agent that reads no goal
AGENT_TASKS = ("pointgoal", "imagegoal", "explore", ANY_TASK)
AGENT_ROBOTS = ("holonomic", "car", "disc")
STOP_COMMAND = (0.0, 0.0, 0.0)  # the motion part of a stop: the robot stays where it is


@dataclass(frozen=True)
class AgentContext:
    """State what a robot may know before it starts: its start pose and a map; after that it sees images only.

    Attributes:
        K: ``(3, 3)`` intrinsic matrix, pixels; the identity without a camera.
        camera: image ``(width, height)``, pixels; ``(0, 0)`` without a camera.
        T_body_cam: ``(4, 4)`` pose of the camera in the body frame, metres.
        limits: of one command: ``(3,)`` largest turn (rad), direction (rad) and step (m); of a car ``(2,)``
            largest speed (m/s) and steering angle (rad); of a disc ``(2,)`` largest turn (rad) and step (m).
        dt: seconds a step.
        map: the learned map; None for an agent that needs none.
        start_pose: ``(3,)`` x (m), y (m), heading (rad) in the map frame.
        body_length: diameter of the robot's footprint, or length of the car's, metres.
        success_radius: a stop within this distance of the goal succeeds, metres; a car only has to come so near.
        noise: standard deviations of a holonomic robot's execution noise: turn (rad), step (m), or root mean squares of
            a longest step where it has a mean; zeros of another's, whose noise only ``transition`` holds.
        transition: the robot's model of its own motion; its controls are the agent's commands.
        car: the car's measures; None for another robot.
        direction_frame: of the direction in a holonomic robot's commands: relative to the heading, or in the world.
        stops: of a car, True where its action ends with a stop, at which success is evaluated (CarNav-v1), and False
            where the episode ends on arrival (CarNav-v0). The action of another robot always has a stop.
        scan_model: the learned model of a laser scanner's scans; None for an agent that needs none.
        scan_encoder: ``q(z | x)`` of that model; None for an agent whose goals are no scans.
    """

    K: np.ndarray
    camera: tuple[int, int]
    T_body_cam: np.ndarray
    limits: np.ndarray
    dt: float
    map: VoxelMap | None
    start_pose: np.ndarray
    body_length: float
    success_radius: float
    noise: tuple[float, float]
    transition: Transition
    car: Car | None = None
    direction_frame: DirectionFrame = "body"
    stops: bool = False
    scan_model: ScanModel | None = None
    scan_encoder: ScanEncoder | None = None


@dataclass(frozen=True)
class Decision:
    """Hold one action and what the agent believed when it chose it.

    Attributes:
        action: ``(4,)`` float32 ``(turn rad, o rad, s m, stop)``; a stop above 0.5 ends the task. Of a disc ``(3,)``
            ``(turn rad, s m, stop)``. Of a car ``(2,)`` ``(speed m/s, steering rad)``, and with ``context.stops``
            ``(3,)`` ``(speed m/s, steering rad, stop)``: it brakes first, because a stop while it rolls fails.
        pose: ``(3,)`` estimate ``(x, y, heading)`` in the map frame; None for an agent that keeps none.
        status: one readable line on the agent's state; reports print it where a run fails.
        latency: seconds by stage: "tracking", "planning", "control".
        plan: ``(n, 2)`` waypoints still to be driven, world frame, metres; None without a plan.
        gives_up: True where the agent ends the task without success, for the reason in ``status``. A stop that gives up
            claims no arrival; a robot without a stop ends its task by this alone.
        covariance: ``(3, 3)`` of the error ``log(T_pose^-1 T_true)`` of ``pose``: forward (m), left (m), turn (rad) in
            the estimate's body frame; the drift of an agent's own map is included, and so
            is the error of a given map that was made at estimated poses. None where an agent states none:
            its pose is observed, or it keeps no belief.
        responses: how often each response to a failure was begun in this task so far, by name; None of an agent that
            does not count them.
        expansions: nodes that the searches of this task have closed so far; None of an agent that does not count them.
    """

    action: np.ndarray
    pose: np.ndarray | None
    status: str
    latency: dict[str, float] = field(default_factory=dict)
    plan: np.ndarray | None = None
    gives_up: bool = False
    covariance: np.ndarray | None = None
    responses: Mapping[str, int] | None = None
    expansions: int | None = None


@runtime_checkable
class Agent(Protocol):
    """Act in an environment: `reset` opens an episode, `act` chooses an action for the newest observation.

    The observation given to `reset` is given to the first `act` again. A goal that changes between two calls of `act`
    is a new task that starts where the robot stands (chained tasks).
    """

    name: str
    robot: str  # that it controls: "holonomic", "car", or "disc" with a laser scanner
    # "pointgoal": drive to observation["goal"]; "imagegoal": to where observation["goal_rgb"] was taken; "explore": map
    # what is there, no goal is observed; ANY_TASK: all of these.
    task: str
    needs_pose: bool  # True: it reads observation["pose"]; oracles and the agents of an observed pose
    needs_map: bool  # True: context.map must be given

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Forget the last episode; all randomness of the next one follows from ``seed``."""
        ...

    def act(self, observation: Observation) -> Decision:
        """Return the action for this observation, always within the context's limits."""
        ...


def decide(agent: Agent, observation: Observation) -> Decision:
    """Return the agent's decision; raise :class:`InputError` where `act` returns anything else.

    A covariance that it holds is checked: it has a pose and is symmetric and positive semi-definite up to rounding.
    """
    decision = agent.act(observation)
    if not isinstance(decision, Decision):
        raise InputError(f"agent {agent.name}", "act", f"a Decision as its result; found {type(decision).__name__}")
    if decision.covariance is not None and not (decision.pose is not None and _is_covariance(decision.covariance)):
        expected = "of (forward, left, turn), (3, 3), symmetric and positive semi-definite, with a pose; or None"
        raise InputError(f"agent {agent.name}", "covariance", expected)
    return decision


def _is_covariance(matrix: np.ndarray) -> bool:
    """Return True for a finite symmetric positive semi-definite ``(3, 3)`` matrix, to single precision."""
    if np.shape(matrix) != (3, 3) or not np.isfinite(matrix).all():
        return False
    slack = 1e-5 * float(np.abs(matrix).max())
    return bool(np.allclose(matrix, np.transpose(matrix), rtol=0.0, atol=slack)) and bool(
        np.linalg.eigvalsh(matrix)[0] >= -slack
    )
