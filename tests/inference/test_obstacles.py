"""Test what an obstacle does to a commanded step, and how long it is remembered."""

import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.inference.tracking.obstacles import is_shown, obstruction, slid, unobstructed

BACK, TURNS = jnp.array([-0.2, 0.0, -0.3]), np.array([False, False, True])


@pytest.mark.parametrize(
    ("moved", "beyond"),
    [
        ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),  # as commanded
        ((-0.2, 0.0, -0.3), (0.0, 0.0, 0.0)),  # it did not move
        ((-0.1, 0.1, -0.1), (0.0, 0.0, 0.0)),  # it slid along a wall at 45 degrees, and turned by less
        ((-0.1, -0.1, 0.0), (0.0, 0.0, 0.0)),
        ((0.05, 0.0, 0.1), (0.05, 0.0, 0.1)),  # it went and turned too far
        ((-0.1, 0.15, -0.4), (0.0, 0.05, -0.1)),  # aside, and the wrong way round
        ((-0.25, 0.0, 0.0), (-0.05, 0.0, 0.0)),  # backwards
    ],
)
def test_an_obstacle_explains_a_shorter_step(moved: tuple[float, ...], beyond: tuple[float, ...]) -> None:
    np.testing.assert_allclose(unobstructed(jnp.array(moved), BACK, TURNS), beyond, atol=1e-6)


@pytest.mark.parametrize("back", [BACK, jnp.array([0.05, -0.12, 0.0]), jnp.array([0.0, 0.0, 0.4])])
def test_obstacles_explain_every_step_that_is_tried(back) -> None:
    """Points of the ball's surface: a step to a wall and along it, ``w = (b . t) t`` for a unit tangent ``t``."""
    steps = slid(back, TURNS)
    assert steps.shape == (4, 3)
    for step in steps:
        np.testing.assert_allclose(unobstructed(step, back, TURNS), 0.0, atol=1e-6)
        along, taken = -np.asarray(back)[:2], np.asarray(step - back)[:2]
        assert taken @ taken == pytest.approx(taken @ along, abs=1e-6)


def test_the_covariance_of_an_obstacle_is_the_size_of_the_command() -> None:
    np.testing.assert_allclose(obstruction(BACK, TURNS), np.diag([0.2**2, 0.2**2, 0.3**2]), rtol=1e-6)


def test_only_an_estimate_of_the_commanded_translation_shows_that_a_body_is_free() -> None:
    across = jnp.diag(jnp.array([0.001, 0.2, 0.2]) ** 2)
    along = jnp.diag(jnp.array([0.2, 0.001, 0.001]) ** 2)
    assert is_shown(across, BACK, TURNS) and not is_shown(along, BACK, TURNS)
    assert not is_shown(1e-9 * jnp.eye(3), jnp.array([0.0, 0.0, 0.3]), TURNS)  # a turn shows nothing
