"""Test the car's parking arenas: bays as wide as stated, what was moved, targets that an oracle of the scene reaches.

The oracle floods the poses from which value iteration finds a path, on the true boxes of the scene in cells of 2 cm
that count as occupied where a box covers any of them, with 1 cm more around the footprint and the real turning circle.
It shares no code with the lattice by which tasks are drawn.
"""

import itertools
import math

import numpy as np
import pytest
import shapely

from tests.helpers.paths import CHECKOUT
from vssm_gym.envs.carnav import CarNavEnv
from vssm_gym.envs.scenes.generator import generate, recorded_spec
from vssm_gym.envs.scenes.generator.parking import (
    BAY,
    BAY_CLEARANCES,
    BEFORE,
    BESIDE_BAY,
    DEPTH,
    MOVED_BY,
    MOVED_OBSTACLES,
    ROOMY,
    YARD_GAP,
    ground,
)
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.envs.tasks.car import CarTask, CarTaskSampler
from vssm_gym.envs.tasks.car_sets import make_car_tasks
from vssm_gym.envs.tasks.splits import split_of
from vssm_gym.errors import InputError
from vssm_gym.eval.sweep.config import load_config
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.planning.value_iteration import PoseGrid, ValueConfig, solve
from vssm_gym.slam import map_building

CAR = Car()
SEEDS = range(4)  # of the training split
CELL = 0.02  # m, of the oracle's floor plan
TIER = load_config(CHECKOUT / "eval" / "configs" / "car_hard.yaml")
JUDGED = [TIER.scenes[0], *(pytest.param(scene, marks=pytest.mark.slow) for scene in TIER.scenes[1:])]


def both(seed: int) -> tuple[Apartment, Apartment]:
    return load_scene(f"procedural:{seed}:parking"), load_scene(f"procedural:{seed}:parking-moved")


def solid(apartment: Apartment) -> dict[str, shapely.Polygon]:
    """Return the outlines of what stands on the floor, walls and marks left out."""
    pieces = [piece for piece in apartment.furniture if piece.category not in (BAY, "picture")]
    return {piece.name: ground(piece) for piece in pieces}


def oracle(apartment: Apartment, margin: float) -> PoseGrid:
    """Return the poses and motions of value iteration on the true boxes of a scene."""
    low = [box for box in apartment.boxes() if box.kind != "floor" and box.center[2] - 0.5 * box.size[2] < CAR.height]
    low = [box for box in low if box.center[2] + 0.5 * box.size[2] > 0.01]
    shape = shapely.union_all([footprint(box) for box in low]).buffer(-1e-6)
    shapely.prepare(shape)
    x, y = np.meshgrid(CELL * np.arange(0.5, 260), CELL * np.arange(0.5, 210), indexing="ij")
    cells = shapely.box(x - 0.5 * CELL, y - 0.5 * CELL, x + 0.5 * CELL, y + 0.5 * CELL)
    arena = Arena.from_occupied(shapely.intersects(cells, shape), np.array([x[0, 0], y[0, 0]]), CELL)
    return PoseGrid.of(
        arena, CAR, ValueConfig(margin=margin, max_sweeps=1)
    )  # the flood before the sweeps is the answer


def within_reach(grid: PoseGrid, task: CarTask) -> bool:
    return solve(grid, np.array(task.goal), start=np.array(task.start)).cost_to_go is not None


@pytest.mark.parametrize("seed", SEEDS)
def test_bays_are_as_wide_as_stated(seed):
    for apartment in both(seed):
        things = shapely.union_all(list(solid(apartment).values()))
        marks = [piece for piece in apartment.furniture if piece.category == BAY]
        assert len(marks) == 12
        for mark in marks:
            box, shape = mark.boxes[0], ground(mark)
            assert shape.intersection(things).area < 1e-6 and box.center[2] + 0.5 * box.size[2] < 0.01
            between_kerbs = box.size[1] == DEPTH
            clear = (box.size[0] - CAR.width if between_kerbs else box.size[1] - CAR.length) / 2
            assert min(abs(clear - stated) for stated in (BAY_CLEARANCES if between_kerbs else (ROOMY,))) < 1e-6
            # the room that a car in the middle has to either side, measured on the solid pieces
            x, y = box.center[:2]
            half = (0.5 * CAR.width, 0.5 * CAR.length)
            assert shapely.box(x - half[0], y - half[1], x + half[0], y + half[1]).distance(things) == pytest.approx(
                clear, abs=1e-3
            )


@pytest.mark.parametrize("seed", SEEDS)
def test_obstacles_were_moved_in_front_of_bays_and_nothing_else_differs(seed):
    before, after = both(seed)
    assert before.walls == after.walls and before.rooms == after.rooms
    pairs = list(zip(before.furniture, after.furniture, strict=True))
    moved = [(one, other) for one, other in pairs if one != other]
    assert len(moved) == MOVED_OBSTACLES
    bays = [p.boxes[0].center for p in after.furniture if p.category == BAY and p.boxes[0].size[1] == DEPTH]
    for one, other in moved:
        assert (one.name, one.category, one.boxes[0].size) == (other.name, other.category, other.boxes[0].size)
        at = other.boxes[0].center
        assert math.dist(one.boxes[0].center, at) >= MOVED_BY
        near = [
            abs(at[0] - x) <= BESIDE_BAY + 0.006 and BEFORE[0] - 0.006 <= abs(at[1] - y) <= BEFORE[1] + 0.006
            for x, y, _ in bays
        ]
        assert any(near)
    yard = {one.name for one, _ in pairs if one.category in ("crate", "barrier", "post", "tyre stack")}
    for apartment in (before, after):
        for (a, one), (b, other) in itertools.combinations(solid(apartment).items(), 2):
            assert one.intersection(other).area < 1e-9
            if a in yard or b in yard:
                assert one.distance(other) >= YARD_GAP - 1e-6


def test_arenas_are_functions_of_their_seed():
    hashes = [apartment.content_hash() for seed in range(3) for apartment in both(seed)]
    assert len(set(hashes)) == 6
    assert hashes == [apartment.content_hash() for seed in range(3) for apartment in both(seed)]
    assert generate(0, "parking-moved") == both(0)[1] and both(0)[1].name == "procedural:0:parking-moved"
    with pytest.raises(InputError, match=r"one of .*parking, parking-moved"):
        generate(0, "moved")
    with pytest.raises(InputError, match=r"parking-moved after the seed; found 'parked'"):
        load_scene("procedural:0:parked")


def test_the_map_is_learned_from_the_arena_before_the_move(tmp_path, monkeypatch):
    """The recording is that of the arena before; the episode runs in the one after."""
    recorded = []

    def record(scene, out, **settings):
        recorded.append((scene, out))
        raise StopIteration

    monkeypatch.setattr(map_building, "record", record)
    for scene in ("procedural:3:parking-moved", "procedural:3:parking", "garage"):
        with pytest.raises(StopIteration):
            map_building.ensure_map(scene, tmp_path, voxel=0.03, seed=0)
    folder = tmp_path / "recordings"
    before = ("procedural:3:parking", folder / "procedural-3-parking")
    assert recorded == [before, before, ("garage", folder / "garage")]
    assert load_scene(recorded_spec("procedural:3:parking-moved")) != load_scene("procedural:3:parking-moved")


def test_episodes_ask_for_bays():
    env = CarNavEnv(scene="procedural:0:parking", images=False, end_on="stop")
    bays = env.sampler.bays
    assert len(bays) == 24
    for seed in range(4):
        _, info = env.reset(seed=seed)
        away = np.abs(bays - np.array(info["task"].goal)).max(axis=1)
        assert away.min() == 0.0
    env.close()
    assert len(CarTaskSampler.of(load_scene("garage"), CAR).bays) == 0


@pytest.mark.slow
@pytest.mark.parametrize("scene", JUDGED)
def test_an_oracle_that_knows_the_scene_reaches_every_target_of_the_tier(scene):
    apartment = load_scene(scene)
    assert split_of(scene) == "test"
    tasks = make_car_tasks(apartment, max(TIER.tasks) + 1).tasks
    grid = oracle(apartment, 0.01)
    assert [task.id for task in tasks if not within_reach(grid, task)] == []


@pytest.mark.slow
def test_the_oracle_refuses_what_does_not_fit():
    """With 8 cm around the footprint no bay between kerbs is wide enough, and the yard is."""
    apartment = load_scene("procedural:0:parking-moved")
    wide, exact = oracle(apartment, max(BAY_CLEARANCES)), oracle(apartment, 0.01)
    tasks = make_car_tasks(apartment, 6).tasks
    bays = [task for task in tasks if min(task.goal[1], 4.2 - task.goal[1]) < 0.65]
    assert len(bays) >= 2
    for task in bays:
        assert within_reach(exact, task) and not within_reach(wide, task)
