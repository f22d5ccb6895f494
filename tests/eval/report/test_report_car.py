"""Test the report of the car: metrics, both simulators side by side, footprints, slices of the cost-to-go."""

import json
import re

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.eval.report.test_report import Page, box_map
from vssm_gym.agents.shared.car.critic import Critic
from vssm_gym.eval.metrics.registry import measured
from vssm_gym.eval.report import car_figures, car_tables, figures, value_figures
from vssm_gym.eval.report.page import write_report
from vssm_gym.geometry.car import Car
from vssm_gym.planning.car.footprint import Arena
from vssm_gym.viz import pictures

CONFIG = {
    "env": ["vssm_gym/CarNav-v0"],
    "scenes": ["arena"],
    "agents": ["vi_mpc", "dwa"],
    "robot": ["car"],
    "noise": ["low"],
    "sensor_noise": ["none"],
    "renderer": ["raycast"],
    "physics": ["mujoco", "bullet"],
    "tasks": list(range(8)),
    "seeds": [0],
    "voxel": 0.03,
}


def episode(agent, physics, task, success=True, collisions=0, **more):
    """Return the row of a straight run of 1.5 m along y = 0.1 task, slower by 10 cm/s in PyBullet."""
    poses = np.stack([np.linspace(0.2, 1.7, 40), np.full(40, 0.1 * task), np.zeros(40)], axis=-1)
    true = poses[:, :2].round(3).tolist()
    return {
        "env": "vssm_gym/CarNav-v0",
        "scene": "arena",
        "scene_hash": "abc",
        "robot": "car",
        "noise": "low",
        "sensor_noise": "none",
        "renderer": "raycast",
        "physics": physics,
        "end_on": "reach",
        "task": task,
        "seed": 0,
        "agent": agent,
        "version": "0.1.0",
        "success": success,
        "spl": 0.8 * success,
        "soft_spl": 0.8,
        "path_length": 1.5,
        "geodesic": 1.2,
        "steps": 60,
        "collisions": collisions,
        "collision_events": collisions,
        "collided": bool(collisions),
        "seconds": 6.0 + (physics == "bullet"),
        "direction_changes": 1,
        "heading_error": 0.1,
        "distance_to_goal": 0.05,
        "location_error_mean": 0.0,
        "location_error_max": 0.0,
        "location_error_final": 0.0,
        "nees": 2.0,
        "in_95": 0.9,
        "latency": {"total": {"p50": 0.03, "p95": 0.05 + 0.001 * task}},
        "failure": None if success else "time out: 1.00 m from the goal after 600 steps",
        "goal": [1.7, 0.1 * task, 0.0],
        "success_radius": 0.1,
        "trace": {
            "true": true,
            "estimate": true,
            "contacts": [[1.0, 0.1]] if collisions else [],
            "poses": poses.round(3).tolist(),
        },
        **more,
    }


def rows_of_a_sweep():
    runs = [(physics, task) for physics in CONFIG["physics"] for task in CONFIG["tasks"]]
    rows = [episode("vi_mpc", *run, collisions=2 if run == ("bullet", 3) else 0) for run in runs]
    return rows + [episode("dwa", *run, success=run[1] > 1) for run in runs]


@pytest.fixture
def sweep_folder(tmp_path):
    manifest = {"config": CONFIG, "config_hash": "0123456789abcdef", "version": "0.1.0", "seed": 0, "episodes": 32}
    (tmp_path / "sweep.json").write_text(json.dumps(manifest))
    (tmp_path / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows_of_a_sweep()))
    return tmp_path


def cells(html):
    """Return the lines of a table as lists of cells, without the elements inside of cells."""
    lines = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", line, re.S) for line in re.findall(r"<tr>(.*?)</tr>", html, re.S)]
    return [[" ".join(re.sub(r"<[^>]*>", "", cell).split()) for cell in line] for line in lines]


def test_the_page_opens_with_reached_and_collided_and_shows_collisions_first(sweep_folder):
    text = write_report(sweep_folder).read_text()
    page = Page(text)
    assert page.open == []
    assert all(link.startswith(("data:", "#")) for link in page.links)
    headline = cells(text[text.index("<table>") : text.index("<details>")])
    assert headline[0][:3] == ["agent", "episodes", "reached %"]
    vi_mpc = dict(zip(headline[0], headline[1], strict=True))
    assert (vi_mpc["agent"], vi_mpc["episodes"]) == ("vi_mpc", "16")  # both simulators together
    assert vi_mpc["reached %"] == "100.0 [63.1, 100.0]"  # 8 tasks: 0.025^(1/8)
    assert vi_mpc["collided %"].startswith("6.2 [")
    assert "SPL" not in page.text
    assert "Sim to sim" in page.headings
    assert "Cost-to-go" not in page.headings  # without a map there is none
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    assert captions[0].startswith("vi_mpc · arena · bullet · low · task 3")  # reached, with a collision
    assert "collision events 2" in captions[0]
    counts = next(table for table in text.split("<table>") if ">failed</th>" in table)
    counts = [line for line in cells(counts) if line[1:3] == ["bullet", "vi_mpc"]]
    assert [line[3:] for line in counts] == [["0 of 8", "", "1"]]  # failed, timed out, collided
    assert "all 4 failures" in page.text
    assert "Clopper and Pearson" in page.text


def test_the_same_rows_give_the_same_page_in_any_order(sweep_folder):
    log = sweep_folder / "episodes.jsonl"
    lines = [json.dumps(row) + "\n" for row in rows_of_a_sweep() if row["task"] in (0, 3)]
    log.write_text("".join(lines))
    first = write_report(sweep_folder).read_bytes()
    log.write_text("".join(reversed(lines)))
    assert write_report(sweep_folder).read_bytes() == first


def test_rows_without_poses_are_drawn_without_footprints(sweep_folder):
    row = episode("vi_mpc", "mujoco", 0)
    del row["trace"]["poses"]
    (sweep_folder / "episodes.jsonl").write_text(json.dumps(row) + "\n")
    text = write_report(sweep_folder).read_text()
    assert "vi_mpc · arena · mujoco" in text
    assert "Sim to sim" not in text  # one simulator alone


def test_metrics_of_arrivals_leave_out_other_runs():
    there, not_there = (measured(episode("dwa", "mujoco", 0, success=s)) for s in (True, False))
    assert (there["seconds_driven"], there["path_ratio"]) == (6.0, pytest.approx(1.25))
    assert there["control_p95_ms"] == pytest.approx(50.0)
    assert not_there["seconds_driven"] is None
    assert not_there["path_ratio"] is None


def test_simulators_stand_side_by_side_with_their_paired_difference():
    rows = [measured(row) for row in rows_of_a_sweep()]
    table = car_tables.simulators(rows, 0)
    header, (mujoco, bullet, difference, *dwa) = table.header, table.lines
    executed, seconds = header.index("executed in"), header.index("seconds")
    assert [line[executed] for line in (mujoco, bullet, difference)] == ["mujoco", "bullet", "bullet - mujoco"]
    assert [line[seconds] for line in (mujoco, bullet)] == ["6.0 [6.0, 6.0]", "7.0 [7.0, 7.0]"]
    assert difference[seconds] == "1.0 [1.0, 1.0]"
    assert difference[header.index("collided %")].startswith("12.5 [-")  # one of eight: not yet a difference
    assert len(dwa) == 3
    assert car_tables.simulators([row for row in rows if row["physics"] == "mujoco"], 0) is None


def test_footprints_are_spaced_by_path_length_forwards_and_backwards():
    x = np.concatenate([np.linspace(0.0, 1.0, 101), np.linspace(1.0, 0.0, 101)])
    chosen = car_figures.apart(np.stack([x, 0.0 * x, 0.0 * x], axis=-1), 0.3)
    np.testing.assert_allclose(x[chosen], [0.0, 0.3, 0.6, 0.9, 0.8, 0.5, 0.2, 0.0], atol=1e-9)
    assert list(car_figures.apart(np.zeros((1, 3)), 0.3)) == [0]  # it never moved
    assert car_figures.apart(np.zeros((5, 3)), 0.3)[-1] == 4


def test_outlines_have_the_footprints_corners_and_the_front_is_bold():
    axes = Figure().subplots()
    corners = Car().corners(np.array([[1.0, 2.0, 0.0], [1.0, 2.0, np.pi / 2]]))
    pictures.draw_outlines(axes, corners, "#000000")
    boxes, fronts = axes.collections
    np.testing.assert_allclose(boxes.get_paths()[0].vertices[:4], corners[0])
    np.testing.assert_allclose(fronts.get_segments()[0][:, 0], 1.325)  # x of the front bumper: 1 + 0.39 - 0.065
    np.testing.assert_allclose(fronts.get_segments()[1][:, 1], 2.325)


def test_an_estimate_that_is_the_truth_is_not_drawn(monkeypatch):
    drawn = []
    monkeypatch.setattr(pictures, "draw_run", lambda axes, row, radius: drawn.append(row["trace"]["estimate"]))
    car_figures.run_picture(episode("vi_mpc", "mujoco", 0), None)
    car_figures.run_picture(episode("vi_mpc", "mujoco", 0, location_error_max=0.05), None)
    assert drawn[0] is None
    assert drawn[1] is not None


@pytest.fixture(scope="module")
def corridor():
    """Return a walled room of 2.4 x 1.2 m and its cost-to-go."""
    occupied = np.ones((68, 34), bool)
    occupied[1:-1, 1:-1] = False
    arena = Arena.from_occupied(occupied, np.zeros(2), 0.035)
    return arena, Critic(arena, Car())


def test_slices_show_the_least_cost_over_headings_and_blocked_cells(corridor, monkeypatch):
    arena, critic = corridor
    poses, goal = np.array([[0.5, 0.6, 0.0], [1.8, 0.6, 0.0]]), np.array([1.8, 0.6, 0.0])
    cost = critic.aim(poses[0], goal).cost_to_go
    planes = []
    plane = value_figures._plane
    monkeypatch.setattr(value_figures, "_plane", lambda axes, a, p, top: planes.append(p) or plane(axes, a, p, top))
    picture = value_figures.slices(arena, cost, poses, goal)
    assert picture[:4] == b"RIFF"
    least, same, _, opposite, _ = planes
    values = np.asarray(cost.values)
    at = tuple(np.round(goal[:2] / 0.035).astype(int))
    assert least[at] == same[at] == 0.0
    assert opposite[at] == values[(*at, values.shape[2] // 2)] > 0.0
    free = np.isfinite(least)
    np.testing.assert_array_equal(least[free], values.min(axis=2)[free])
    np.testing.assert_array_equal(free, (values < cost.never).any(axis=2))
    assert np.isfinite(same[5, 17])
    assert not np.isfinite(opposite[5, 17])  # the front would be in the wall


def test_an_unreachable_target_is_named_instead_of_drawn(corridor, monkeypatch):
    arena, _ = corridor
    monkeypatch.setattr(value_figures, "arena_from_map", lambda *_: arena)
    image, caption = value_figures.ValuePainter(box_map()).paint(
        episode("vi_mpc", "mujoco", 0, goal=[2.36, 0.6, 0.0])  # the car's front in the wall
    )
    assert image == b""
    assert caption


def test_both_simulators_are_among_the_runs_that_are_drawn():
    chosen = figures.choose_successes(rows_of_a_sweep(), limit=4)
    assert {(row["agent"], row["physics"]) for row in chosen} == {
        (agent, physics) for agent in CONFIG["agents"] for physics in CONFIG["physics"]
    }
