"""Test the car's arenas: gaps of clear width, bays to park in, dead ends to back out of, and textures."""

import itertools
import math

import numpy as np
import pytest
import shapely

from tests.helpers.car_worlds import arc
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.scenes.solids import footprint
from vssm_gym.envs.tasks.car import CarTaskSampler
from vssm_gym.geometry.car import Car

CAR = Car()
DRAWN = ("depot", "dock", "garage", "paddock")
INNER = shapely.box(0.1, 0.1, 5.1, 4.1)


def standing(scene: str) -> list[tuple[str, shapely.Polygon]]:
    boxes = load_scene(scene).boxes()
    low = [box for box in boxes if box.kind == "furniture" and box.center[2] - 0.5 * box.size[2] < CAR.height]
    return [(box.name, footprint(box)) for box in low]


@pytest.mark.parametrize("scene", DRAWN)
def test_gaps_are_passable_or_far_too_narrow(scene):
    pieces = standing(scene)
    assert len(pieces) >= 10 and INNER.buffer(1e-6).contains(shapely.union_all([shape for _, shape in pieces]))
    gaps = {(a, b): one.distance(other) for (a, one), (b, other) in itertools.combinations(pieces, 2)}
    gaps |= {(name, "wall"): INNER.exterior.distance(shape) for name, shape in pieces}
    assert {pair: gap for pair, gap in gaps.items() if 0.12 < gap < 0.38 - 1e-6} == {}
    assert sum(gap < 0.75 for gap in gaps.values() if gap >= 0.38 - 1e-6) >= 4  # and some of them are tight
    for (_, one), (_, other) in itertools.combinations(pieces, 2):
        assert one.intersection(other).area < 1e-9


@pytest.mark.parametrize("scene", DRAWN)
def test_everything_is_textured(scene):
    """Floor, walls and objects have contrast for a tracker, and no two arenas have the same materials."""
    apartment = load_scene(scene)
    looks = [box.material.texture for box in apartment.boxes() if box.kind in ("floor", "wall", "furniture")]
    assert "plain" not in looks and "plaster" not in looks
    # a wall's two faces: the facade is the same all around, the inner materials differ
    assert len({wall.front.texture for wall in apartment.walls} | {wall.back.texture for wall in apartment.walls}) == 5
    floors = {load_scene(name).rooms[0].floor for name in (*DRAWN, "arena")}
    assert len(floors) == 5


@pytest.mark.parametrize("bay", [0, 2, 3, 5])
@pytest.mark.parametrize("heading", [0.5 * math.pi, -0.5 * math.pi])
def test_the_garages_free_bays_can_be_parked_in_either_way(bay, heading):
    sampler = CarTaskSampler.of(load_scene("garage"), CAR)
    goal = (1.43 + 0.48 * bay, 3.7 if heading > 0.0 else 3.9, heading)
    assert sampler.space.free(np.array(goal), 0.05)
    sampler.validate(sampler.task((2.6, 2.5, 0.0), goal))


def test_the_garages_gaps_can_be_parked_in_along_the_wall():
    sampler = CarTaskSampler.of(load_scene("garage"), CAR)
    for x in (1.215, 2.405, 3.595):
        sampler.validate(sampler.task((2.6, 2.5, 0.0), (x, 0.25, 0.0)))


@pytest.mark.parametrize("start", [(0.8, 1.12, math.pi), (0.8, 1.8, math.pi), (4.4, 1.88, 0.0), (4.4, 2.44, 0.0)])
def test_the_docks_alleys_can_only_be_left_backwards(start):
    """No chain of forward arcs leads out, and one of backward arcs does."""
    sampler = CarTaskSampler.of(load_scene("dock"), CAR)
    space, inside = sampler.space, (lambda poses: (poses[:, 0] < 1.2) | (poses[:, 0] > 3.9))
    poses = np.array([start])
    assert space.free(poses).all()
    for _ in range(20):
        after = [arc(pose, 0.05, bend / CAR.turning_radius) for pose in poses for bend in (-1.0, -0.5, 0.0, 0.5, 1.0)]
        following = np.array(after).reshape(-1, 3)
        following = following[space.free(following)]
        if not len(following):
            break
        assert inside(following).all()
        _, kept = np.unique(np.round(following / [0.01, 0.01, 0.05]), axis=0, return_index=True)
        poses = following[kept]
    backwards = np.array([arc(np.array(start), -distance, 0.0) for distance in np.arange(0.0, 1.0, 0.05)])
    assert space.free(backwards, 0.05).all() and not inside(backwards[-1:]).any()
    sampler.validate(sampler.task((2.6, 2.3, 0.0), start))
