"""Clone the behaviour of ``astar``: its planner drives imagined robots, and a policy's network imitates it.

The expert is ``astar``'s own navigator in the same map. It reads its pose from the observation, because imagination
simulates the estimate of its tracker. It sees the whole map, the policy only a policy's observations. Demonstrations
are kept next to the policy until that is written, so that an interrupted training can be resumed.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vssm_gym.agents.policy.features import size_of
from vssm_gym.agents.shared.localization import TruePose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.agents.shared.navigator import Navigator
from vssm_gym.agents.shared.surroundings import KnownMap
from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols.agent_context import context_of
from vssm_gym.files.atomic import atomic_write
from vssm_gym.files.bounded import open_file
from vssm_gym.files.npz_file import open_npz
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.training.environment import BODY, make_training_env, stream
from vssm_gym.training.run import Run

DEMONSTRATIONS = "demonstrations.npz"
DEMONSTRATION_BYTES = 4 << 30  # what a training may have collected: ten million steps of 100 features
COLLECTING = 0.8  # fraction of the minutes; the rest is for fitting


def clone(run: Run) -> None:
    """Collect ``steps`` of the expert, fit, and write the policy; demonstrations survive an interruption."""
    from vssm_gym.training.sb3.cloning import fit

    config = run.config
    settings = config.algorithm
    assert settings.name == "bc"
    kept = run.out / DEMONSTRATIONS
    if run.policy_file.is_file() and not kept.is_file():
        return  # it has ended already
    vectors, actions = collect(run, *_restored(kept, run))
    with atomic_write(kept) as temporary, temporary.open("wb") as file:
        np.savez(file, vectors=vectors, actions=actions, steps=run.steps, seconds=run.seconds)
    if run.interrupted():
        return
    if not len(vectors):
        raise InputError("train", "steps", "enough of them, and minutes, for the expert to act; it never did")
    epochs_done: list[int] = []
    row = {"steps": run.steps, "episodes": 0, "return": None, "length": None, "success": None}

    def on_epoch(epoch: int, loss: float) -> None:
        epochs_done.append(epoch)
        run.report({**row, "epoch": epoch, "loss": round(loss, 6)}, lambda: None)

    layers = fit(
        vectors,
        actions,
        config.policy.hidden,
        config.policy.activation,
        epochs=settings.epochs,
        batch_size=settings.batch_size,
        learning_rate=settings.learning_rate,
        seed=config.seed,
        on_epoch=on_epoch,
        stop=run.over,
    )
    if run.interrupted():
        return
    if not epochs_done:
        raise InputError("train", "minutes", f"enough of them to drive and to fit {len(vectors)} steps once")
    run.check(array for layer in layers for array in layer)
    run.end(row, lambda: run.write_policy(layers, "clip"))
    kept.unlink()


def collect(run: Run, vectors: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Collect observations of a policy ``(n, inputs)`` and the expert's actions in [-1, 1] ``(n, 3)``, float32.

    The given ones, of an earlier session, come first.
    """
    from vssm_gym.training.sb3.learner import wrapped

    config, minutes = run.config, run.config.minutes
    view = make_training_env(config.environment, config.policy.inputs, config.seed)
    env: Any = wrapped(view, config.policy.frames)
    n = config.environment.num_envs
    experts = Experts(VoxelMap.load(config.environment.map or ""), n)
    env.seed(stream(config.seed, run.steps))
    seen = env.reset()
    experts.begin(view.shown, np.ones(n, bool))
    seen_by, done, steps = [vectors], [actions], run.steps
    while steps < config.steps and not run.over():
        if minutes is not None and run.seconds > 60.0 * minutes * COLLECTING:
            break
        action, drives = experts.act(view.shown)
        seen_by.append(seen[drives])
        done.append(action[drives])
        seen, _, ended, _ = env.step(action)
        run.stepped()
        if ended.any():
            experts.begin(view.shown, ended)
        steps += n
        run.report({"steps": steps, "episodes": 0, "return": None, "length": None, "success": None}, lambda: None)
    run.stepped()  # an earlier session may have collected all
    env.close()
    return np.concatenate(seen_by), np.concatenate(done)


def _restored(kept: Path, run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Restore the demonstrations and the clock of an earlier session; empty without such a file."""
    spec = run.config.policy
    if not kept.is_file():
        run.begin()
        return np.zeros((0, spec.frames * size_of(spec.inputs)), np.float32), np.zeros((0, 3), np.float32)
    expected = "the data that the training had collected; remove it to start again"
    with open_npz(open_file(kept), kept, DEMONSTRATION_BYTES, expected) as stored:
        n, width = (*stored.shapes["actions"], 0)[0], spec.frames * size_of(spec.inputs)
        if stored.shapes["vectors"] != (n, width) or stored.shapes["actions"] != (n, 3):
            raise InputError(kept, "vectors, actions", f"of shapes (steps, {width}) and (steps, 3)")
        found = stored.read("vectors"), stored.read("actions")
        run.resume(int(stored.read("steps")), float(stored.read("seconds")))
    return found


class Experts:
    """Hold one navigator a robot, all in one map."""

    def __init__(self, m: VoxelMap, n: int) -> None:
        robot = HolonomicRobot()
        self._context = partial(
            context_of,
            robot,
            robot.body_length,
            success_radius=BODY.success_radius,
            noise=NOISE_LEVELS["none"],
            voxel_map=m,
        )
        self._navigators = [Navigator(KnownMap(TruePose()), NavigationConfig()) for _ in range(n)]
        self._goals = np.zeros((n, 2))

    def begin(self, shown: dict[str, np.ndarray], which: np.ndarray) -> None:
        """Begin episodes of some robots; their goals are computed once, from their pose estimates."""
        pose, goal = shown["pose"].astype(np.float64), shown["goal"].astype(np.float64)
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        direction = np.stack([c * goal[:, 1] - s * goal[:, 2], s * goal[:, 1] + c * goal[:, 2]], axis=-1)
        self._goals[which] = (pose[:, :2] + goal[:, :1] * direction)[which]
        for i in np.flatnonzero(which).tolist():
            self._navigators[i].reset(self._context(pose[i]), self._observation(shown, i), 0)

    def act(self, shown: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return actions ``(n, 3)`` in [-1, 1], float32, and which of them drive, since policies cannot stop."""
        decided = np.array([one.act(self._observation(shown, i)).action for i, one in enumerate(self._navigators)])
        actions = 2.0 * (decided[:, :3] - BODY.low) / (BODY.high - BODY.low) - 1.0
        return actions.astype(np.float32), decided[:, 3] <= 0.5

    def _observation(self, shown: dict[str, np.ndarray], i: int) -> dict[str, np.ndarray]:
        return {"pose": shown["pose"][i], "goal": self._goals[i]}
