"""Test the car's critic: refused goals, and starts that are occupied in the map."""

import numpy as np
import pytest
import shapely

from vssm_gym.agents.shared.car.critic import Critic
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.value_iteration import ValueStatus

CAR = Car()
CELL = 0.035
GOAL = np.array([3.3, 0.8])
FREE, POST = np.array([0.8, 0.8, 0.0]), shapely.box(0.8, 0.78, 0.84, 0.82)


def arena(*solids: shapely.Geometry) -> Arena:
    """Return a room of 4 x 1.6 m with ``solids`` in it."""
    room = shapely.box(0.0, 0.0, 4.0, 1.6)
    solid = shapely.union_all([room.buffer(0.2) - room, *solids])
    x, y = np.meshgrid(np.arange(-0.1, 4.1, CELL), np.arange(-0.1, 1.7, CELL), indexing="ij")
    half = 0.5 * CELL
    occupied = shapely.intersects(solid, shapely.box(x - half, y - half, x + half, y + half))
    return Arena.from_occupied(occupied, np.array([-0.1, -0.1]), CELL)


@pytest.mark.parametrize("under", [(), (POST,)], ids=["free start", "a post under the car"])
def test_a_goal_behind_a_wall_is_refused_from_every_start(under):
    wall = shapely.box(2.0, 0.0, 2.05, 1.6)
    result = Critic(arena(wall, *under), CAR).aim(FREE, GOAL)
    assert result.status is ValueStatus.UNREACHABLE
    assert result.cost_to_go is None


@pytest.mark.parametrize("under", [(), (POST,)], ids=["free start", "a post under the car"])
def test_a_car_in_an_obstacle_of_the_map_may_leave_it(under):
    result = Critic(arena(*under), CAR).aim(FREE, GOAL)
    assert result.status is ValueStatus.CONVERGED
    assert result.cost_to_go is not None


def test_a_start_beside_the_map_is_refused():
    result = Critic(arena(), CAR).aim(np.array([-3.0, 0.8, 0.0]), GOAL)
    assert result.status is ValueStatus.UNREACHABLE
