"""Test ``bench car``: the size of its plan, its sealed room, its bicycle, and the whole benchmark once."""

import importlib.util
import json

import jax.numpy as jnp
import numpy as np
import pytest

from tests.helpers.car_worlds import yard
from vssm_gym.cli.bench import bench
from vssm_gym.envs.scenes.scene import load_scene, save_scene
from vssm_gym.errors import InputError
from vssm_gym.eval.bench import car as bench_car
from vssm_gym.eval.bench import envs as bench_envs
from vssm_gym.geometry.car import Car
from vssm_gym.model.transition import Bicycle
from vssm_gym.planning.value_iteration import PoseGrid, solve

ARENAS = ("arena", "depot", "dock", "garage", "paddock")


@pytest.mark.parametrize("scene", ARENAS)
def test_the_cars_arenas_make_160_by_128_cells(scene):
    plan = bench_car.floor_plan(load_scene(scene), Car())
    arena = bench_car.rasterised(*plan)
    assert arena.occupied.shape == (160, 128)
    assert 0.5 < np.mean(~arena.occupied) < 0.9
    assert np.all(bench_car.sealed_off(*plan).occupied >= arena.occupied)


@pytest.mark.slow
def test_the_sealed_corner_is_out_of_reach():
    """No motion leads out of it, from poses that are free in it and had a path while it was open."""
    solid, low, high = bench_car.floor_plan(load_scene("arena"), Car())
    goal = np.array([1.0, 1.0])
    plain = solve(PoseGrid.of(bench_car.rasterised(solid, low, high), Car()), goal)
    grid = PoseGrid.of(bench_car.sealed_off(solid, low, high), Car())
    shut = solve(grid, goal)
    x, y = (grid.arena.origin[a] + grid.arena.resolution * np.arange(grid.blocked.shape[a]) for a in (0, 1))
    corner = ~grid.blocked & ((x > high[0] - bench_car.SEALED)[:, None] & (y > high[1] - bench_car.SEALED))[..., None]
    assert plain.cost_to_go is not None and shut.cost_to_go is not None
    never = np.float32(shut.cost_to_go.never)
    assert np.count_nonzero(np.asarray(plain.cost_to_go.values)[corner] < never) > 100
    assert np.all(np.asarray(shut.cost_to_go.values)[corner] == never)


@pytest.mark.parametrize("control", [(0.6, 0.3), (-0.4, 0.5), (0.2, 0.0), (0.0, 0.2)])
def test_without_errors_the_bicycle_drives_its_arc(monkeypatch, control):
    monkeypatch.setattr(bench_car, "SPEED_ERROR", 0.0)
    monkeypatch.setattr(bench_car, "STEERING_ERROR", 0.0)
    start = np.array([0.3, -0.2, 3.0])
    car = Car()
    driven = bench_car._driven(start, np.array(control), np.random.default_rng(0), car)
    exact = Bicycle(wheelbase=car.wheelbase).mean(jnp.asarray(start), jnp.asarray(control), car.dt)
    np.testing.assert_allclose(driven, np.asarray(exact), atol=1e-6)


def test_an_arena_without_room_is_refused_before_anything_is_measured(tmp_path):
    save_scene(yard(0.6, 0.6), tmp_path / "yard.json")
    with pytest.raises(InputError, match="room for a car"):
        bench_car.measure(scene=str(tmp_path / "yard.json"), steps=1, seed=0)


@pytest.mark.slow
def test_the_whole_bench(monkeypatch, tmp_path, capsys):
    """Two steps of each controller, and short windows: every part runs, and is in the table and in the file."""
    monkeypatch.setattr(bench_envs, "WINDOW_SECONDS", 0.05)
    for few in ("GOALS", "CONTROLLED_TARGETS"):
        monkeypatch.setattr(bench_car, few, 3)
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pybullet" else found(name))
    bench("car", out=tmp_path, trials=2)
    result = json.loads((tmp_path / "car-arena.json").read_text())
    parts = [row["what"] for row in result["rows"]]
    assert [what.split()[0] for what in parts] == ["value", "the", "MPC", "MPC", "MPC", "hybrid", "CarNav", "CarNav"]
    assert "160x128x64" in parts[0]
    value = result["rows"][0]
    assert value["facts"]["residual"] < 1e-3
    assert 0 < value["facts"]["unreachable"] < value["facts"]["free"]
    for row in result["rows"]:
        assert 0.0 < row["p50"] <= (row["p95"] or np.inf)
    for row in result["rows"][2:5]:
        assert row["aim"] == 100.0
        assert row["facts"]["recompilations"] == 0
        assert row["facts"]["collided"] == 0
    shown = capsys.readouterr().out
    assert "bench car: arena" in shown
    assert "PyBullet is not installed" in shown
