"""Test that an agent's own map knows where its body has been, what has held it, and where its camera is blind."""

import dataclasses

import numpy as np
import pytest
import shapely

from tests.agents import test_agents
from tests.agents.car.test_car_agents import context
from vssm_gym.agents.shared.localization import Localization
from vssm_gym.agents.shared.own_map import OwnMap, OwnMapConfig
from vssm_gym.geometry.car import Car
from vssm_gym.inference.status import Status
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.planning.occupancy_grid import FREE, OCCUPIED, UNKNOWN

CAR = Car()
CONFIG = OwnMapConfig(voxel=0.04, extent=4.0, slots=200, ring=0.06, close_range=0.0)
FAR = {"depth": np.full((8, 8), 5.0, np.float32), "rgb": np.zeros((8, 8, 3), np.uint8)}


class Standing:
    """Map nothing, at one pose."""

    def __init__(self, planar):
        self.at = Localization(np.asarray(planar, float), np.zeros(3), Status.OK)

    def reset(self, prior: VoxelMap, context, observation):
        self.map = prior
        return self.at

    def update(self, command, observation):
        """Move by ``command``, in the world."""
        self.at = dataclasses.replace(self.at, planar=self.at.planar + command)
        return self.at


def plan_of(planar, car=CAR, bumped=None):
    own = OwnMap(dataclasses.replace(context(), car=car), Standing(planar), CONFIG, FAR)
    if bumped is not None:
        own.bump(np.asarray(planar, float), bumped)
    return own.plan()


def known(plan, outline) -> np.ndarray:
    """Return which cell centres lie in an outline."""
    i, j = np.meshgrid(*(np.arange(n) for n in plan.cells.shape), indexing="ij")
    return shapely.contains_xy(outline, *np.moveaxis(plan.centres(np.stack([i, j], -1)), -1, 0))


@pytest.mark.parametrize("planar", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.7), (-0.4, 0.1, -2.5)])
def test_its_rectangle_and_the_ring_around_it_are_free(planar):
    plan = plan_of(planar)
    body = shapely.Polygon(CAR.corners(np.array(planar)))
    assert (plan.cells[known(plan, body)] == FREE).all()
    assert (plan.cells[known(plan, body.buffer(CONFIG.ring - 1e-6))] == FREE).all()
    assert (plan.cells[~known(plan, body.buffer(CONFIG.ring + 1e-6))] == UNKNOWN).all()


def test_another_robot_is_a_disc():
    plan = plan_of((0.2, 0.1, 1.0), car=None)
    disc = shapely.Point(0.2, 0.1).buffer(0.5 * context().body_length + CONFIG.ring, quad_segs=256)
    assert (plan.cells[known(plan, disc.buffer(-1e-3))] == FREE).all()
    assert (plan.cells[~known(plan, disc.buffer(1e-3))] == UNKNOWN).all()


@pytest.mark.parametrize("car", [CAR, None])
def test_a_ring_that_follows_a_disc_stays_where_a_car_started(car):
    """A car backs onto what its camera never showed: only what it has stood on becomes free."""
    own = OwnMap(dataclasses.replace(context(), car=car), Standing(np.zeros(3)), CONFIG, FAR)
    for _ in range(10):
        own.take(np.array([-0.03, 0.0, 0.0]), FAR)
    plan = own.plan()
    half = 0.5 * context().body_length
    first, last = (
        (shapely.Polygon(CAR.corners(at)) if car else shapely.Point(at[:2]).buffer(half, quad_segs=256))
        for at in (np.zeros(3), np.array([-0.3, 0.0, 0.0]))
    )
    stood = shapely.union_all([first, last]).convex_hull
    free = stood.union(first.buffer(CONFIG.ring)) if car else stood.buffer(CONFIG.ring, quad_segs=256)
    assert (plan.cells[known(plan, free.buffer(-2e-3))] == FREE).all()
    assert (plan.cells[~known(plan, free.buffer(2e-3))] == UNKNOWN).all()


@pytest.mark.parametrize("ahead", [True, False])
def test_what_has_held_it_is_an_obstacle_at_that_end(ahead):
    planar = np.array([0.3, -0.2, 0.7])
    plan = plan_of(planar, bumped=ahead)
    end = CAR.center_forward + (0.5 if ahead else -0.5) * CAR.length
    there = np.argwhere(plan.cells == OCCUPIED)
    along = (plan.centres(there) - planar[:2]) @ [np.cos(0.7), np.sin(0.7)]
    assert len(there) >= 3 and np.abs(along - end).max() < 2.0 * CONFIG.voxel
    assert not known(plan, shapely.Polygon(CAR.corners(planar)))[tuple(there.T)].any()


@pytest.mark.parametrize("heading", [0.0, 2.1])
def test_what_has_no_depth_is_nearer_than_the_camera_measures(heading):
    """The left half of the image has no depth: what is close on that side is occupied, until it is doubted."""
    planar, camera = np.array([0.1, 0.2, heading]), test_agents.CAMERA
    half = np.broadcast_to(np.arange(camera.width) >= camera.width // 2, (camera.height, camera.width))
    half_blind = {"depth": np.where(half, 5.0, 0.0).astype(np.float32), "rgb": np.zeros((*half.shape, 3), np.uint8)}
    own = OwnMap(test_agents.context(None, planar), Standing(planar), CONFIG, half_blind)
    c, s = np.cos(heading), np.sin(heading)
    left, right = (planar[:2] + 0.3 * np.array([c - s * t, s + c * t]) / np.hypot(1.0, t) for t in (0.4, -0.4))
    plan = own.plan(keep=np.stack([left, right]))
    assert plan.state(left) == OCCUPIED
    assert plan.state(right) == UNKNOWN
    occupied = plan.centres(np.argwhere(plan.cells == OCCUPIED))
    assert np.hypot(*(occupied - planar[:2]).T).max() < CONFIG.blind_range + 2.0 * CONFIG.voxel
    assert plan.state(planar[:2]) == FREE  # the body is there
    assert own.doubt(planar[:2], 1.0)
    assert not (own.plan().cells == OCCUPIED).any()
