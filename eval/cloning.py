"""Behaviour cloning of ``astar``: its planner drives imagined robots, and a policy's network learns to do the same.

The expert is ``astar``'s own navigator in the same map; where it is it reads from the observation, because imagination
gives the estimate that its tracker would. It sees the whole map, the policy what any policy sees. What was collected
lies in memory only: a training that is interrupted before the network is fitted begins anew.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.localization import TruePose
from vssm_gym.agents.navigation import NavigationConfig, Navigator
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.errors import InputError
from vssm_gym.eval.training_env import BODY, make_training_env
from vssm_gym.voxel_map import VoxelMap

if TYPE_CHECKING:
    from vssm_gym.eval.training import Run

SHARE_COLLECTING = 0.8  # of the minutes; the rest is for fitting


def clone(run: "Run") -> None:
    """Collect ``steps`` of the expert's, fit, and write the policy."""
    from vssm_gym.agents.sb3.cloning import fit

    config = run.config
    settings = config.algorithm
    assert settings.name == "bc"
    vectors, actions = collect(run)
    if not len(vectors):
        raise InputError("train", "steps", "enough of them, and minutes, for the expert to act; it never did")
    row = {"steps": len(vectors), "episodes": 0, "return": None, "length": None, "success": None}
    layers = fit(
        vectors,
        actions,
        config.policy.hidden,
        config.policy.activation,
        epochs=settings.epochs,
        batch_size=settings.batch_size,
        learning_rate=settings.learning_rate,
        seed=config.seed,
        told=lambda epoch, loss: run.tell({**row, "epoch": epoch, "loss": round(loss, 6)}, lambda: None),
        stop=run.over,
    )
    run.steps = len(vectors)
    run.end(row, lambda: run.write_policy(layers, "clip"))


def collect(run: "Run") -> tuple[np.ndarray, np.ndarray]:
    """What a policy would have seen ``(n, inputs)``, and what the expert did in [-1, 1] ``(n, 3)``, float32."""
    from vssm_gym.agents.sb3.learner import wrapped

    config, minutes = run.config, run.config.minutes
    view = make_training_env(config.environment, config.policy.inputs)
    env: Any = wrapped(view, config.policy.frames)
    n = config.environment.num_envs
    experts = Experts(VoxelMap.load(config.environment.map or ""), n)
    env.seed(config.seed)
    seen = env.reset()
    experts.begin(view.shown, np.ones(n, bool))
    vectors, actions, steps = [], [], 0
    while steps < config.steps and not run.over():
        if minutes is not None and run.seconds > 60.0 * minutes * SHARE_COLLECTING:
            break
        action = experts.act(view.shown)
        vectors.append(seen.copy())
        actions.append(action)
        seen, _, ended, _ = env.step(action)
        if ended.any():
            experts.begin(view.shown, ended)
        steps += n
        run.tell({"steps": steps, "episodes": 0, "return": None, "length": None, "success": None}, lambda: None)
    env.close()
    empty: Callable[[int], np.ndarray] = lambda width: np.zeros((0, width), np.float32)
    return np.concatenate([empty(seen.shape[1]), *vectors]), np.concatenate([empty(3), *actions])


class Experts:
    """One navigator a robot, all in one map."""

    def __init__(self, m: VoxelMap, n: int) -> None:
        robot = HolonomicRobot()
        self._context: dict[str, Any] = {
            "K": np.eye(3),
            "camera": (1, 1),
            "T_body_cam": robot.T_body_cam,
            "limits": robot.limits,
            "dt": robot.dt,
            "map": m,
            "body_length": robot.body_length,
            "success_radius": BODY.success_radius,
            "noise": (0.0, 0.0),
        }
        self._navigators = [Navigator(TruePose(), NavigationConfig()) for _ in range(n)]
        self._goals = np.zeros((n, 2))

    def begin(self, shown: dict[str, np.ndarray], which: np.ndarray) -> None:
        """New episodes of some robots; goals are taken from where the robots believe to be, once."""
        pose, goal = shown["pose"].astype(np.float64), shown["goal"].astype(np.float64)
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        direction = np.stack([c * goal[:, 1] - s * goal[:, 2], s * goal[:, 1] + c * goal[:, 2]], axis=-1)
        self._goals[which] = (pose[:, :2] + goal[:, :1] * direction)[which]
        for i in np.flatnonzero(which).tolist():
            context = AgentContext(start_pose=pose[i], **self._context)
            self._navigators[i].reset(context, self._observation(shown, i), 0)

    def act(self, shown: dict[str, np.ndarray]) -> np.ndarray:
        """Actions ``(n, 3)`` in [-1, 1], float32."""
        told = [one.act(self._observation(shown, i)).action[:3] for i, one in enumerate(self._navigators)]
        return (2.0 * (np.array(told) - BODY.low) / (BODY.high - BODY.low) - 1.0).astype(np.float32)

    def _observation(self, shown: dict[str, np.ndarray], i: int) -> dict[str, np.ndarray]:
        return {"pose": shown["pose"][i], "goal": self._goals[i]}
