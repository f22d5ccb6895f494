"""Run many LSTM policies through a maze at once, in compiled loops: the share of tiles that each visits.

The step is that of :class:`~vssm_gym.envs.lidar_maze.LidarMazeEnv`: execution noise, contacts, exact ranges with noise.
"""

import math

import numpy as np
from jaxtyping import Float
from numba import njit

from vssm_gym.envs.physics.planar import scan, slide
from vssm_gym.envs.tasks.maze_objectives import TILE


@njit(cache=True, nogil=True)
def rollouts(
    parameters: np.ndarray,
    mean: np.ndarray,
    std: np.ndarray,
    hidden: int,
    starts: np.ndarray,
    rectangles: np.ndarray,
    counted: np.ndarray,
    motion: np.ndarray,
    noise: np.ndarray,
    limits: np.ndarray,
    radius: float,
    longest: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the coverage of each policy ``(n,)``, and count, sums and sums of squares of the inputs ``(3, inputs)``.

    Args:
        parameters: ``(n, size)`` of the policies, in the order of
            :func:`vssm_gym.agents.shared.planar.lstm_policy.unpacked`.
        mean: ``(inputs,)`` of the ranges, m.
        std: ``(inputs,)`` likewise.
        hidden: units.
        starts: ``(n, 3)`` x, y (m), heading (rad).
        rectangles: ``(m, 6)`` of the maze.
        counted: ``(tiles, tiles)`` bool, tiles that count.
        motion: ``(n, steps, 2)`` errors of turn (rad) and step (m).
        noise: ``(n, steps, inputs)`` of the ranges, m.
        limits: largest turn (rad) and step (m).
        radius: of the robot, m.
        longest: m, of a reading.
    """
    n, steps, inputs, tiles = len(parameters), motion.shape[1], len(mean), counted.shape[0]
    wide = inputs + hidden
    coverage, sums = np.zeros(n), np.zeros((3, inputs))
    pose, joined, gates = np.empty((1, 3)), np.zeros(wide), np.zeros(4 * hidden)
    bias, out = 4 * hidden * wide, 4 * hidden * (wide + 1)
    for k in range(n):
        p = parameters[k]
        h, c = np.zeros(hidden), np.zeros(hidden)
        visited = np.zeros((tiles, tiles), np.bool_)
        x, y, heading = starts[k, 0], starts[k, 1], starts[k, 2]
        for t in range(steps + 1):
            i = min(max(int(x / TILE), 0), tiles - 1)
            j = min(max(int(y / TILE), 0), tiles - 1)
            visited[i, j] = visited[i, j] or counted[i, j]
            if t == steps:
                break
            pose[0, 0], pose[0, 1], pose[0, 2] = x, y, heading
            ranges = scan(pose, rectangles, inputs)[0]
            for b in range(inputs):
                r = ranges[b] + noise[k, t, b]
                r = longest if r <= 0.0 or r > longest else r
                sums[0, b] += 1.0
                sums[1, b] += r
                sums[2, b] += r * r
                joined[b] = (r - mean[b]) / std[b]
            for b in range(hidden):
                joined[inputs + b] = h[b]
            for a in range(4 * hidden):
                total = p[bias + a]
                for b in range(wide):
                    total += p[a * wide + b] * joined[b]
                gates[a] = total
            for a in range(hidden):
                c[a] = _logistic(gates[hidden + a]) * c[a] + _logistic(gates[a]) * math.tanh(gates[2 * hidden + a])
                h[a] = _logistic(gates[3 * hidden + a]) * math.tanh(c[a])
            turn, step = p[out + 2 * hidden], p[out + 2 * hidden + 1]
            for a in range(hidden):
                turn += p[out + a] * h[a]
                step += p[out + hidden + a] * h[a]
            turn, step = limits[0] * math.tanh(turn), limits[1] * _logistic(step)
            e = motion[k, t, 0]
            moved = max(0.0, step + motion[k, t, 1]) if step > 0.0 else 0.0
            x, y, _ = slide(x, y, moved * math.cos(heading + e), moved * math.sin(heading + e), radius, rectangles)
            if turn != 0.0:
                heading += math.copysign(max(0.0, abs(turn) + e), turn)
        coverage[k] = visited.sum() / max(1, counted.sum())
    return coverage, sums


@njit(cache=True, nogil=True)
def _logistic(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-x))


def draws(
    rng: np.random.Generator, n: int, steps: int, inputs: int, motion: tuple[float, float], ranges: float
) -> tuple[Float[np.ndarray, "n steps 2"], Float[np.ndarray, "n steps inputs"]]:
    """Draw the errors of motions and of ranges, the same for the two sides of a direction.

    Args:
        rng: of the errors.
        n: rollouts, two a direction.
        steps: of each.
        inputs: ranges a step.
        motion: standard deviations of turn (rad) and step (m).
        ranges: standard deviation, m.
    """
    half = n // 2
    moved = rng.normal(size=(half, steps, 2)) * np.array(motion)
    read = rng.normal(size=(half, steps, inputs)) * ranges
    return np.repeat(moved, 2, axis=0), np.repeat(read, 2, axis=0)


def starts_of(rng: np.random.Generator, places: Float[np.ndarray, "places 2"], n: int) -> Float[np.ndarray, "n 3"]:
    """Draw start poses at given places, the same for the two sides of a direction."""
    half = n // 2
    at = places[rng.integers(len(places), size=half)]
    return np.repeat(np.column_stack([at, rng.uniform(-np.pi, np.pi, half)]), 2, axis=0)
