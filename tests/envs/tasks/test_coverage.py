"""Test that coverage counts exactly what a camera can see from free places."""

import numpy as np
import pytest
import shapely

from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.physics.tracing import EmbreeTracer
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.tasks.coverage import COVERAGE_CELL, SEEING_RANGE, Coverage, Observable

ROBOT = HolonomicRobot()
AROUND = 2.0 * np.pi


def observable(**keywords) -> tuple[Observable, FreeSpace]:
    apartment = two_rooms(**keywords)
    space = FreeSpace.from_apartment(apartment, ROBOT.radius, ROBOT.height)
    return Observable(space, EmbreeTracer(apartment.boxes()), ROBOT.camera_height), space


def centres(seen: Observable) -> np.ndarray:
    return seen.origin + COVERAGE_CELL * (np.stack(np.indices(seen.cells.shape), axis=-1) + 0.5)


def test_all_of_an_empty_room_can_be_seen_and_nothing_beyond_its_walls():
    seen, space = observable()
    floor = shapely.union_all(list(space.rooms.values()))
    at = centres(seen)[seen.cells]
    assert shapely.contains_xy(floor.buffer(COVERAGE_CELL), at).all()
    walls = two_rooms().walls
    thick = shapely.union_all(
        [shapely.LineString([w.start, w.end]).buffer(w.thickness / 2, cap_style="flat") for w in walls]
    )
    assert seen.area == pytest.approx((floor - thick).area, rel=0.06)  # cells that walls cut count whole


def test_a_closed_off_room_is_not_observable():
    both, _ = observable()
    one, space = observable(openness=0.0, leaves=1)
    room = next(room for room in space.rooms.values() if room.intersects(space.largest))
    assert one.area < 0.7 * both.area
    assert shapely.contains_xy(room.buffer(COVERAGE_CELL), centres(one)[one.cells]).all()


def test_a_wardrobe_occludes_and_a_low_table_does_not():
    empty, _ = observable()
    tall, _ = observable(pieces=(furniture("wardrobe", (1.5, 2.0, 1.0), (1.0, 1.0, 2.0)),))
    low, _ = observable(pieces=(furniture("table", (1.5, 2.0, 0.15), (1.0, 1.0, 0.3)),))
    assert empty.area - tall.area == pytest.approx(1.0, abs=0.4)
    assert empty.area == pytest.approx(low.area, abs=0.05)


def test_coverage_never_falls_and_can_be_completed():
    seen, space = observable()
    coverage = Coverage(seen, np.pi / 2)
    rng, before = np.random.default_rng(0), 0.0
    for xy in space.sample(rng, 200):
        gained = coverage.see(np.array([*xy, rng.uniform(-np.pi, np.pi)]))
        assert gained >= 0.0 and coverage.fraction == pytest.approx(before + gained)
        before = coverage.fraction
    assert 0.99 < before <= 1.0
    coverage.reset()
    assert coverage.fraction == 0.0


def test_a_camera_sees_a_sector_as_long_as_its_reach():
    """In a hall without obstacles nearby, the visible area is that of a circular sector."""
    seen, space = observable()
    coverage = Coverage(seen, np.pi / 3)
    xy = np.array(space.largest.representative_point().coords[0])
    coverage.see(np.array([*xy, 0.3]))
    at = centres(seen)[coverage.seen] - xy
    bearing = np.abs((np.arctan2(at[:, 1], at[:, 0]) - 0.3 + np.pi) % AROUND - np.pi)
    away = np.hypot(*at.T)
    assert away.max() <= SEEING_RANGE + COVERAGE_CELL
    assert (bearing[away > 0.5] <= np.pi / 6 + np.arctan2(COVERAGE_CELL, 0.5)).all()


def test_neighbouring_rays_leave_no_cell_out():
    """For every field of view, each visible cell inside the sector is marked."""
    seen, space = observable()
    xy = np.array(space.largest.representative_point().coords[0])
    fine, coarse = np.zeros_like(seen.cells), Coverage(seen, np.pi / 2)
    seen.mark(xy, np.linspace(-np.pi / 4, np.pi / 4, 5000), fine)
    coarse.see(np.array([*xy, 0.0]))
    fine &= seen.cells
    assert (coarse.seen & fine).sum() >= 0.97 * fine.sum()
