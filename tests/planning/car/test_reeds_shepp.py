"""Test Reeds-Shepp paths against laws, closed cases, and feasible drives, none of which is shorter."""

import math

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import example, given, settings

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.planning.car import reeds_shepp as rs

RADIUS = 0.5  # m
poses = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3.1, 3.1)).map(np.array)
HALF_PI = 0.5 * math.pi


def drive(lengths: np.ndarray, steerings: np.ndarray, radius: float = RADIUS) -> np.ndarray:
    """Return the poses ``(..., 3)`` to which segments ``(..., n)`` lead from the origin: turns about circle centres."""
    p, heading = np.zeros(lengths.shape[:-1], complex), np.ones(lengths.shape[:-1], complex)
    for s, side in zip(np.moveaxis(lengths, -1, 0), np.moveaxis(steerings, -1, 0), strict=True):
        turn = np.exp(1j * side * s / radius)
        centre = p + 1j * side * radius * heading
        p = np.where(side == 0, p + s * heading, centre + (p - centre) * turn)
        heading = heading * np.where(side == 0, 1.0, turn)
    return np.stack([p.real, p.imag, np.angle(heading)], axis=-1)


def between(start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Return the goal in the start's frame, ``(..., 3)``."""
    d, c, s = goal[..., :2] - start[..., :2], np.cos(start[..., 2]), np.sin(start[..., 2])
    return np.stack(
        [c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0], goal[..., 2] - start[..., 2]], axis=-1
    )


# A turn in place: a word of four segments is as long as one of three, to rounding.
@example(np.array([0.0, 0.0, 1.0682779451908888]), np.array([0.0, 0.0, 0.6538125073270544]), 1.0)
@given(poses, poses, st.floats(0.1, 2.0))
def test_the_path_ends_at_the_goal(start, goal, radius):
    curve = rs.path(start, goal, radius)
    end = drive(curve.lengths, curve.steerings, radius)
    expected = between(start, goal)
    np.testing.assert_allclose(end[:2], expected[:2], atol=1e-9)
    assert abs(wrap_angle(np.array(end[2] - expected[2]))) < 1e-9
    assert curve.length == pytest.approx(float(rs.length(start, goal, radius)), abs=1e-9)
    assert len(curve.lengths) <= 5
    assert curve.cusps <= 2  # no shortest path needs more


@settings(max_examples=100)
@given(poses)
def test_every_solution_of_every_word_ends_at_the_goal(goal):
    lengths, steerings = np.empty((rs.SOLUTIONS, 5)), np.empty((rs.SOLUTIONS, 5), np.int8)
    count = rs.words(*goal, lengths, steerings)
    end = drive(lengths[:count], steerings[:count], 1.0)
    np.testing.assert_allclose(end[:, :2] - goal[:2], 0.0, atol=1e-9)
    np.testing.assert_allclose(wrap_angle(end[:, 2] - goal[2]), 0.0, atol=1e-9)


@given(poses, poses, poses)
def test_length_is_a_metric(a, b, c):
    """Symmetric (drive the same path backwards), a triangle inequality, zero only from a pose to itself."""
    assert float(rs.length(a, b, RADIUS)) == pytest.approx(float(rs.length(b, a, RADIUS)), abs=1e-9)
    assert float(rs.length(a, c, RADIUS)) <= float(rs.length(a, b, RADIUS) + rs.length(b, c, RADIUS)) + 1e-9
    assert float(rs.length(a, a, RADIUS)) == 0.0


@given(poses)
def test_length_is_invariant_under_reversal_and_mirroring(goal):
    x, y, a = goal
    variants = np.array([[x, y, a], [-x, y, -a], [x, -y, -a], [-x, -y, a]])
    np.testing.assert_allclose(np.ptp(rs.length(np.zeros(3), variants, RADIUS)), 0.0, atol=1e-9)


@given(poses, poses)
def test_lower_bounds(start, goal):
    """No path is shorter than the line or the turn at full lock; a larger turning radius never shortens it."""
    value = float(rs.length(start, goal, RADIUS))
    turn = abs(float(wrap_angle(np.array(goal[2] - start[2]))))
    assert value >= max(math.hypot(*(goal - start)[:2]), RADIUS * turn) - 1e-9
    assert value <= float(rs.length(start, goal, 1.3 * RADIUS)) + 1e-9


# Signed lengths are drawn with these signs and steerings; Q and q: a quarter of a circle forwards, backwards.
WORDS = {
    "CSC": ("+++", "LSL", "+++", "LSR"),
    "CCC": ("+-+", "LRL", "++-", "LRL", "+--", "LRL"),
    "CCCC": ("++--", "LRLR", "+--+", "LRLR"),
    "CCSC": ("+q--", "LRSL", "+q--", "LRSR"),
    "CSCC": ("++Q-", "LSRL", "++Q-", "LSLR"),
    "CCSCC": ("+q-q+", "LRSLR"),
}
SIDES = {"L": 1, "S": 0, "R": -1}


def drawn(signs: str, sides: str, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draw ``count`` drives of one word with random lengths, mirrored and reversed at random."""
    lengths = rng.uniform(0.0, HALF_PI * RADIUS, (count, len(sides)))
    if len(sides) == 4 and "S" not in sides:
        lengths[:, 2] = lengths[:, 1]
    for i, sign in enumerate(signs):
        if sign in "Qq":
            lengths[:, i] = HALF_PI * RADIUS
        if sign in "-q":
            lengths[:, i] *= -1.0
        if sides[i] == "S":
            lengths[:, i] *= 3.0
    steerings = np.broadcast_to([SIDES[s] for s in sides], lengths.shape)
    flip, mirror = rng.choice([-1.0, 1.0], (2, count, 1))
    return lengths * flip, (steerings * mirror).astype(int)


CASES = [(kind, word[i], word[i + 1]) for kind, word in WORDS.items() for i in range(0, len(word), 2)]


@pytest.mark.parametrize(("kind", "signs", "sides"), CASES)
def test_no_word_with_random_lengths_is_shorter(kind, signs, sides):
    """Every word is the shortest one for some drive, and is found there, so that none is missing."""
    lengths, steerings = drawn(signs, sides, 20_000, np.random.default_rng(5))
    excess = np.abs(lengths).sum(axis=1) - rs.length(np.zeros(3), drive(lengths, steerings), RADIUS)
    assert excess.min() > -1e-9
    assert np.count_nonzero(excess < 1e-9) > 5, kind


def test_no_random_drive_is_shorter():
    """Drives have six segments of any steering up to full lock and any sign."""
    rng = np.random.default_rng(3)
    lengths = rng.normal(0.0, 0.6, (100_000, 6))
    curvature = np.clip(rng.uniform(-1.5, 1.5, lengths.shape), -1.0, 1.0)
    p, heading = np.zeros(len(lengths), complex), np.zeros(len(lengths))
    for s, k in zip(lengths.T, curvature.T / RADIUS, strict=True):
        p = p + s * np.sinc(0.5 * s * k / np.pi) * np.exp(1j * (heading + 0.5 * s * k))
        heading = heading + s * k
    end = np.stack([p.real, p.imag, heading], axis=-1)
    assert np.all(np.abs(lengths).sum(axis=1) >= rs.length(np.zeros(3), end, RADIUS) - 1e-9)


@pytest.mark.parametrize(
    "goal", [(0.1, 0.3, 0.2), (-0.2, 0.6, 1.2), (0.4, -0.4, 2.8), (0.0, 0.4, 0.0), (0.0, 0.0, 3.1)]
)
def test_a_numerical_search_finds_nothing_shorter_and_comes_as_near(goal):
    """``min sum |l|`` over all sign-free words of five segments by many starts of a penalised descent."""
    from scipy.optimize import minimize

    goal = np.array(goal)
    rng, best = np.random.default_rng(0), math.inf
    sides = np.array([[1, 0, -1, 1, -1], [1, -1, 0, 1, -1], [1, -1, 1, -1, 0]])

    def miss(lengths, side):
        x, y, heading = drive(lengths, side)
        return [x - goal[0], y - goal[1], math.sin(0.5 * (heading - goal[2]))]

    for trial in range(60):
        side = sides[trial % 3] * rng.choice([-1, 1])
        found = minimize(
            lambda lengths: float(np.sqrt(lengths**2 + 1e-8).sum()),
            rng.normal(0.0, 0.4, 5),
            method="SLSQP",
            constraints={"type": "eq", "fun": miss, "args": (side,)},
            options={"maxiter": 100, "ftol": 1e-10},
        )
        if np.abs(miss(found.x, side)).max() < 1e-6:
            best = min(best, float(np.abs(found.x).sum()))
    value = float(rs.length(np.zeros(3), goal, RADIUS))
    assert value <= best + 1e-4
    assert best == pytest.approx(value, rel=0.02)


@pytest.mark.parametrize(
    ("goal", "expected"),
    [
        ((2.0, 0.0, 0.0), 2.0),
        ((-2.0, 0.0, 0.0), 2.0),
        ((RADIUS, RADIUS, HALF_PI), HALF_PI * RADIUS),  # a quarter to the left
        ((-RADIUS, -RADIUS, HALF_PI), HALF_PI * RADIUS),  # backwards with the wheels to the right
        ((RADIUS + 1.0, RADIUS, HALF_PI), 1.0 + HALF_PI * RADIUS),  # straight, then a quarter
        ((0.0, 0.0, math.pi), math.pi * RADIUS),  # on the spot: three sixths of a circle, |heading| R is the bound
        ((0.0, 2.0 * RADIUS, math.pi), math.pi * RADIUS),  # half a circle
        ((4.0, 0.5, 0.0), None),  # Dubins' path LSR
    ],
)
def test_closed_cases(goal, expected):
    if expected is None:
        # LSR with equal arcs t: 4 = 2 R sin t + u cos t, 0.5 = 2 R (1 - cos t) + u sin t
        from scipy.optimize import fsolve

        f = lambda v: [
            2 * RADIUS * math.sin(v[0]) + v[1] * math.cos(v[0]) - goal[0],
            2 * RADIUS * (1 - math.cos(v[0])) + v[1] * math.sin(v[0]) - goal[1],
        ]
        t, u = fsolve(f, [0.1, 3.0])
        expected = 2.0 * RADIUS * t + u
    assert float(rs.length(np.zeros(3), np.array(goal), RADIUS)) == pytest.approx(expected, abs=1e-9)


@given(poses, poses, st.floats(0.02, 0.5))
def test_samples_lie_on_the_path(start, goal, step):
    curve = rs.path(start, goal, RADIUS)
    points, gears = rs.sample(curve, step)
    assert points.shape == (len(gears), 3)
    np.testing.assert_allclose(points[0], start)
    np.testing.assert_allclose(points[-1, :2], goal[:2], atol=1e-9)
    hops = rs.length(points[:-1], points[1:], RADIUS)
    assert np.all(hops <= step + 1e-9)
    assert hops.sum() == pytest.approx(curve.length, abs=1e-8)  # each hop is itself a shortest path
    forward = np.sum(np.diff(points[:, :2], axis=0) * _middle(points), axis=1)
    assert np.all(forward * gears[1:] >= -1e-12)
    assert set(np.unique(gears)) <= {-1, 1}


def _middle(points: np.ndarray) -> np.ndarray:
    """Return unit directions halfway between the headings of neighbours."""
    turn = wrap_angle(np.diff(points[:, 2]))
    angle = points[:-1, 2] + 0.5 * turn
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def test_many_pairs_broadcast():
    rng = np.random.default_rng(0)
    starts, goals = rng.uniform(-2, 2, (4, 1, 3)), rng.uniform(-2, 2, (5, 3))
    values = rs.length(starts, goals, RADIUS)
    assert values.shape == (4, 5)
    assert values[2, 3] == pytest.approx(rs.path(starts[2, 0], goals[3], RADIUS).length)


@pytest.mark.parametrize(
    ("call", "field"),
    [
        (lambda: rs.length(np.zeros(2), np.zeros(3), 1.0), "start"),
        (lambda: rs.path(np.zeros(3), np.full(3, np.nan), 1.0), "goal"),
        (lambda: rs.path(np.zeros((2, 3)), np.zeros(3), 1.0), "shape"),
        (lambda: rs.length(np.zeros(3), np.zeros(3), 0.0), "radius"),
        (lambda: rs.sample(rs.path(np.zeros(3), np.ones(3), 1.0), 0.0), "step"),
    ],
)
def test_bad_input_is_named(call, field):
    with pytest.raises(InputError, match=field):
        call()
