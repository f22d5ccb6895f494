"""Drive by a trained policy, ``policy:FILE``; the pose is tracked in the learned map.

    z_t by the tracker of ``astar``;   command = policy(scan of the depth image, goal and pose as z_t has them)

The agent stops where ``astar`` would: within the success radius, less a margin for the estimate's uncertainty. Training
ends episodes on arrival instead. The goal is therefore shown farther by that margin, so that the radius at which the
policy learned to arrive is where the agent stops. Without an estimate that may be believed it does as ``astar`` does.
Described in ``docs/agents/policies.md``.
"""

import math
import time

import numpy as np

from vssm_gym.agents.base import AgentContext, Decision, Observation
from vssm_gym.agents.policy import policy_file
from vssm_gym.agents.policy.command_history import CommandHistory
from vssm_gym.agents.policy.features import features, relative, size_of
from vssm_gym.agents.shared.localization import FilteredPose, Localization
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.trust import Conduct, gave_up
from vssm_gym.errors import InputError
from vssm_gym.geometry.scan import BEAMS, scan_of

CONFIG = NavigationConfig()  # its rule for stopping is that of ``astar``
SAME_ANGLE = 0.01  # rad by which the camera's angle of view may differ from that of training: half a beam of the scan


class PolicyAgent:
    """Localise against the map and command by a policy file; deterministic.

    Args:
        policy: of a file, or the file's path.

    Raises:
        InputError: at construction, a file that :func:`vssm_gym.agents.policy.policy_file.load` refuses; at reset, a
            robot or camera that differs from that of the training.
    """

    name = "policy"  # an instance has its file's
    robot = "holonomic"
    task = "pointgoal"
    needs_pose = False
    needs_map = True

    def __init__(self, policy: policy_file.Policy | str) -> None:
        self.policy = policy_file.loaded(policy) if isinstance(policy, str) else policy
        self.name = self.policy.spec.name
        self._localizer = FilteredPose("tracker")

    def reset(self, context: AgentContext, observation: Observation, seed: int) -> None:
        """Open an episode; nothing here is random, so ``seed`` changes nothing."""
        self._check(context, observation)
        self._context = context
        self._command: np.ndarray | None = None
        self._history = CommandHistory(1)
        self._estimate = self._localizer.reset(context, observation)
        spec = self.policy.spec
        self._seen = np.zeros((spec.frames, size_of(spec.parts)), np.float32)

    def act(self, observation: Observation) -> Decision:
        """Return the next action from the newest observation; see :class:`vssm_gym.agents.base.Agent`."""
        began = time.perf_counter()
        if self._command is not None:
            self._estimate = self._localizer.update(self._command, observation)
        estimate, tracked = self._estimate, time.perf_counter()
        rim = stop_radius(self._context.success_radius, estimate)
        goal = relative(estimate.planar, observation["goal"], self._context.success_radius - rim)
        near = goal[0] <= self._context.success_radius
        self._look(observation, goal, estimate)
        conduct = CONFIG.lost.conduct(estimate.lost, estimate.status)
        turn = np.array([self._context.limits[0], 0.0, 0.0])
        if conduct is Conduct.GIVE_UP:
            activity, stop, command = gave_up(estimate.lost), True, np.zeros(3)
        elif conduct is Conduct.WAIT:
            activity, stop, command = "waiting: lost", False, np.zeros(3)
        elif conduct is Conduct.SEARCH or (near and estimate.lost):
            activity, stop, command = "looking around: lost", False, turn
        elif near:
            activity, stop, command = "arrived", True, np.zeros(3)
        else:
            activity, stop, command = "driving", False, self.policy(self._seen.reshape(-1))
        self._command = sent = np.asarray(command, np.float32)
        self._history.add(sent[None])
        latency = {"tracking": tracked - began, "control": time.perf_counter() - tracked}
        status = f"{activity}; localization: {estimate.status}"
        action = np.array([*sent, float(stop)], np.float32)
        gives_up, pose = conduct is Conduct.GIVE_UP, estimate.planar.copy()
        return Decision(action, pose, status, latency, gives_up=gives_up, covariance=estimate.covariance)

    def commands(self, observations: Observation) -> np.ndarray:
        """Return the policy's commands of imagined robots, ``(num_envs, 3)``: turn (rad), direction (rad), step (m).

        Args:
            observations: of ``vssm_gym/WorldModelNav-v0``, whose poses are estimates already.

        Raises:
            InputError: a policy whose input is no single observation: of several steps, or of its last commands.
        """
        spec = self.policy.spec
        if spec.frames != 1:
            raise InputError(spec.name, "frames", f"a policy of one observation; it reads {spec.frames}")
        if "commands" in spec.parts:
            raise InputError(spec.name, "inputs", "a policy of one observation; it reads its last commands as well")
        return np.asarray(self.policy(features(observations, spec.parts)))

    def _look(self, observation: Observation, goal: np.ndarray, estimate: Localization) -> None:
        spec = self.policy.spec
        shown = {
            "scan": scan_of(observation["depth"], spec.max_depth),
            "goal": goal,
            "pose": estimate.planar,
            "pose_std": body_std(estimate),
            "commands": self._history.commands[0],
        }
        self._seen = np.roll(self._seen, -1, axis=0)
        self._seen[-1] = features(shown, spec.parts)

    def _check(self, context: AgentContext, observation: Observation) -> None:
        spec, width = self.policy.spec, observation["depth"].shape[-1]
        if not np.allclose(context.limits, spec.high, atol=1e-6):
            found = f"found {np.round(context.limits, 4).tolist()}"
            raise InputError(spec.name, "limits", f"a robot with {np.round(spec.high, 4).tolist()} a step; {found}")
        hfov = 2.0 * math.atan(0.5 * width / float(context.K[0, 0]))
        if width < BEAMS or abs(hfov - spec.hfov) > SAME_ANGLE:
            found = f"found {width} pixels, {math.degrees(hfov):.1f}"
            expected = f"at least {BEAMS} pixels wide, {math.degrees(spec.hfov):.1f} degrees; {found}"
            raise InputError(spec.name, "camera", expected)
        if not math.isclose(context.success_radius, spec.success_radius, rel_tol=1e-6):
            expected = f"{spec.success_radius:g} m; found {context.success_radius:g}"
            raise InputError(spec.name, "success_radius", expected)


def body_std(estimate: Localization) -> np.ndarray:
    """Return ``(3,)`` standard deviations forward, left (m) and of the turn (rad); x and y count as independent."""
    c, s = math.cos(estimate.planar[2]), math.sin(estimate.planar[2])
    x, y, turn = estimate.std
    return np.array([math.hypot(c * x, s * y), math.hypot(s * x, c * y), turn])


def stop_radius(success_radius: float, estimate: Localization) -> float:
    """Return the distance to the goal (m) at which a stop is safe for the estimate's uncertainty, as for ``astar``."""
    spread = float(np.max(estimate.std[:2]))
    return max(CONFIG.least_radius, success_radius - CONFIG.stop_margin - CONFIG.stop_sigmas * spread)
