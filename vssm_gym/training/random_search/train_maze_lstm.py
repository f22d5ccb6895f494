"""Train an LSTM to visit the tiles of one maze, by augmented random search on their share (the baseline of DVBF-LM).

python -m vssm_gym.training.random_search.train_maze_lstm pillars-v1 OUT.npz --iterations 1500
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from vssm_gym.agents.shared.planar.lstm_policy import LstmPolicy, size_of
from vssm_gym.envs.lidar_maze import LONGEST_RANGE
from vssm_gym.envs.maze_noise import motion_noise, range_noise
from vssm_gym.envs.tasks.maze_objectives import MazeCoverage
from vssm_gym.envs.tasks.mazes import ROBOT, load_maze
from vssm_gym.training.random_search.maze_rollouts import draws, rollouts, starts_of
from vssm_gym.training.random_search.search import Moments, SearchConfig, climb

FIRST_PARAMETERS = 0.1  # standard deviation of the parameters that the search starts from
FIRST_DRIVE = 1.0  # of the step's bias at the start: the robot drives, and sees something
CHECKED = 32  # rollouts by which the best parameters of a training are chosen
CHECKED_EVERY = 50  # iterations between two checks


@dataclass(frozen=True)
class LstmTraining:
    """Configure a training.

    Args:
        iterations: of the search.
        steps: of a rollout.
        inputs: ranges that the policy reads.
        hidden: units.
        noise: of the execution, and ``sensor_noise`` of the ranges: levels of LidarMaze.
        search: of the parameters.
        seed: of everything.
    """

    iterations: int = 600
    steps: int = 1000
    inputs: int = 16
    hidden: int = 16
    noise: str = "low"
    sensor_noise: str = "low"
    search: SearchConfig = field(default_factory=SearchConfig)
    seed: int = 0


def train(maze: str, config: LstmTraining, on_check: Callable[[int, float, float], None] | None = None) -> LstmPolicy:
    """Return the policy with the highest coverage in checks along the training.

    Args:
        maze: its name; starts are those of its tasks, with any heading.
        config: of the training.
        on_check: called with the iteration, the mean coverage of its rollouts, and that of the check.
    """
    world = load_maze(maze)
    counted = MazeCoverage(world.space).counted
    places = np.unique(np.array([task.start[:2] for task in world.tasks.tasks]), axis=0)
    motion, ranges = motion_noise(config.noise), range_noise(config.sensor_noise)
    limits = ROBOT.limits[[0, 2]].astype(np.float64)
    rng = np.random.default_rng(config.seed)

    def run(theta: np.ndarray, moments: Moments, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        n = len(theta)
        errors = draws(rng, n, config.steps, config.inputs, (motion.turn, motion.step), ranges.floor)
        given = moments.mean, moments.std, config.hidden, starts_of(rng, places, n), world.rectangles, counted
        return rollouts(theta, *given, *errors, limits, ROBOT.radius, LONGEST_RANGE)

    def evaluate(theta: np.ndarray, moments: Moments) -> tuple[np.ndarray, Moments]:
        coverage, sums = run(theta, moments, rng)
        return coverage, Moments(float(sums[0, 0]), sums[1], sums[2])

    theta = FIRST_PARAMETERS * rng.normal(size=size_of(config.inputs, config.hidden))
    theta[-1] = FIRST_DRIVE
    moments, best, began = Moments.of(config.inputs), (-1.0, theta, Moments.of(config.inputs), 0), time.perf_counter()
    for k in range(config.iterations):
        theta, moments, reward = climb(theta, moments, evaluate, config.search, rng)
        if (k + 1) % CHECKED_EVERY == 0:
            checked, _ = run(np.repeat(theta[None], CHECKED, axis=0), moments, np.random.default_rng(config.seed + 1))
            found = float(checked.mean())
            best = max(best, (found, theta.copy(), moments, k + 1), key=lambda one: one[0])
            if on_check:
                on_check(k + 1, reward, found)
    coverage, theta, moments, at = best
    trained = {
        "algorithm": "augmented random search V2-t",
        "maze": maze,
        "iterations": config.iterations,
        "best": at,
        "coverage": round(coverage, 4),
        "steps": config.steps,
        "seed": config.seed,
        "seconds": round(time.perf_counter() - began, 1),
    }
    return LstmPolicy(config.inputs, config.hidden, theta, moments.mean, moments.std, trained)
