"""Test that the car's agents arrive without a collision or refuse before they drive, and the rows of a sweep."""

import json
import math

import gymnasium as gym
import jax.numpy as jnp
import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.box_rooms import furniture, two_rooms
from tests.helpers.planning_worlds import voxel_map
from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.registry import AGENTS
from vssm_gym.envs.robots.car_noise import CarNoise
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks.car import CarTask
from vssm_gym.envs.tasks.car_sets import CarTaskSet, load, make_car_tasks, save
from vssm_gym.errors import InputError
from vssm_gym.eval.protocols.agent_context import transition_of
from vssm_gym.eval.protocols.carnav import direction_changes, run_episode, shortest_curve
from vssm_gym.geometry.car import GOAL_HEADING_TOLERANCE, GOAL_RADIUS, Car
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.transition import Bicycle
from vssm_gym.planning.car import reeds_shepp

CAR = Car()
CARS = [name for name, agent in AGENTS.items() if agent.robot == "car"]
CRATE = furniture("crate", (1.5, 1.2, 0.25), (0.6, 0.4, 0.5))
ROOMS = two_rooms(pieces=(CRATE,))
FLOOR = shapely.box(0.05, 0.05, 5.95, 3.95)
SOLIDS = [
    (shapely.box(2.95, 0.0, 3.05, 1.5), 0.0, 2.0),  # the wall on both sides of the doorway
    (shapely.box(2.95, 2.4, 3.05, 4.0), 0.0, 2.0),
    (shapely.box(1.2, 1.0, 1.8, 1.4), 0.0, 0.5),
]
SEALED = [(shapely.box(4.0, 0.0, 5.9, 1.9) - shapely.box(4.15, 0.15, 5.75, 1.75), 0.0, 0.6)]


@pytest.fixture(scope="module")
def learned() -> VoxelMap:
    return voxel_map(FLOOR, SOLIDS)


def task(goal: tuple[float, ...], start=(0.8, 2.6, 0.3)) -> CarTask:
    return CarTask(id=0, scene=ROOMS.name, start=start, goal=goal)


def run(name: str, learned: VoxelMap, goal: tuple[float, ...], physics: str = "mujoco", env=None) -> dict:
    agent = AGENTS[name]()
    made = env or gym.make(
        "vssm_gym/CarNav-v0",
        scene=ROOMS,
        noise="low",
        physics=physics,
        observe_pose=agent.needs_pose,
        images=not agent.needs_pose,
        reward="sparse",
    )
    row = run_episode(made, agent, task(goal), seed=3, voxel_map=learned)
    made.close()
    return row


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CARS if AGENTS[name].needs_pose and name != "dwa"])
@pytest.mark.parametrize("goal", [(2.2, 0.7, 2.5), (4.6, 2.0, -1.5)])
def test_it_parks_without_a_collision(name, goal, learned):
    row = run(name, learned, goal)
    assert row["success"] and not row["collided"] and row["failure"] is None
    assert row["geodesic"] <= row["path_length"] + 1e-9 and row["spl"] > 0.4
    assert row["location_error_max"] is row["nees"] is None  # the pose is observed
    assert len(row["trace"]["poses"]) <= 80 and row["trace"]["poses"][0] == pytest.approx([0.8, 2.6, 0.3], abs=0.01)
    json.dumps(row, allow_nan=False)


@pytest.mark.slow
def test_the_dynamic_window_reaches_at_least_the_position(learned):
    row = run("dwa", learned, (4.6, 2.0, -1.5))
    assert row["distance_to_goal"] < GOAL_RADIUS and not row["collided"]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CARS if AGENTS[name].needs_map])
def test_a_target_out_of_reach_is_refused_before_driving(name):
    row = run(name, voxel_map(FLOOR, SOLIDS + SEALED), (4.9, 0.9, 0.0))
    assert row["steps"] == 0 and row["path_length"] == 0.0 and not row["success"]
    assert row["failure"].startswith("planner: ")


class Scrambled(gym.Wrapper):
    """Replace all that agents must not see by noise, unless the harness needs it."""

    def __init__(self, env: gym.Env, seed: int) -> None:
        super().__init__(env)
        self.rng, self.actions = np.random.default_rng(seed), []

    def reset(self, **options):
        observation, info = self.env.reset(**options)
        return observation, info | {"T_world_cam": self.rng.normal(size=(4, 4))}

    def step(self, action):
        self.actions.append(np.array(action))
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, info | {"collision": bool(self.rng.integers(2))}


@pytest.mark.slow
@pytest.mark.parametrize("name", CARS)
def test_no_agent_uses_info(name, learned):
    agent, actions = AGENTS[name](), []
    for seed in range(2):
        made = gym.make(
            "vssm_gym/CarNav-v0",
            scene=ROOMS,
            max_episode_steps=8,
            camera={"width": 64, "height": 48},
            observe_pose=agent.needs_pose,
            reward="sparse",
        )
        env = Scrambled(made, seed)
        run_episode(env, agent, task((2.2, 0.7, 2.5)), seed=5, voxel_map=learned)
        actions.append(np.array(env.actions))
        made.close()
    assert len(actions[0]) == 8 and np.abs(actions[0]).max() > 0.0
    np.testing.assert_array_equal(*actions)


def context() -> AgentContext:
    return AgentContext(
        K=np.eye(3),
        camera=(8, 8),
        T_body_cam=CAR.T_body_cam,
        limits=CAR.limits,
        dt=CAR.dt,
        map=None,
        start_pose=np.zeros(3),
        body_length=CAR.length,
        success_radius=GOAL_RADIUS,
        noise=(0.0, 0.0),
        transition=Bicycle(wheelbase=CAR.wheelbase),
        car=CAR,
    )


def test_an_agent_without_a_map_is_refused():
    with pytest.raises(InputError, match="map"):
        AGENTS["dwa"]().reset(context(), {"goal": np.zeros(3), "pose": np.zeros(3)}, 0)


@given(st.floats(-0.6, 0.6), st.floats(-0.52, 0.52), st.floats(-3.0, 3.0))
def test_the_prior_of_a_car_is_its_arc(speed, steering, heading):
    """The prior moves along the chord of the arc, which starts at half the turn and is shorter by a sinc."""
    way = speed * CAR.dt
    turn = way * math.tan(steering) / CAR.wheelbase
    chord = way * np.sinc(0.5 * turn / np.pi)
    direction = heading + 0.5 * turn
    start = np.array([0.3, -0.2, heading])
    motion = transition_of(CAR, CarNoise())
    after = np.asarray(motion.mean(jnp.asarray(start), jnp.asarray([speed, steering]), CAR.dt), np.float64)
    np.testing.assert_allclose(
        after[:2], start[:2] + chord * np.array([math.cos(direction), math.sin(direction)]), atol=1e-6
    )
    assert math.remainder(heading + turn - after[2], 2 * math.pi) == pytest.approx(0.0, abs=1e-5)


poses = st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3.1, 3.1)).map(np.array)


@given(poses, poses)
def test_no_curve_into_the_region_is_longer_than_one_to_its_middle(start, goal):
    radius = CAR.turning_radius
    length = shortest_curve(start, goal, radius)
    middle = float(reeds_shepp.length(start, goal, radius))
    assert length <= max(1e-3, middle + 1e-9)
    assert length >= math.hypot(*(goal[:2] - start[:2])) - GOAL_RADIUS - 1e-9
    assert shortest_curve(start, goal[:2], radius) <= length + GOAL_HEADING_TOLERANCE * radius  # any heading will do


def test_direction_changes_count_turns_not_stops():
    assert direction_changes(np.array([0.3, 0.3, 0.0, 0.2, -0.2, 0.01, -0.3, 0.4])) == 2
    assert direction_changes(np.array([])) == 0


@pytest.fixture(scope="module")
def tasks() -> CarTaskSet:
    return make_car_tasks(load_scene("arena"), 6)


def test_targets_form_a_chain_whose_beginning_does_not_depend_on_its_length(tasks):
    assert [t.id for t in tasks.tasks] == list(range(6))
    assert all(b.start == a.goal for a, b in zip(tasks.tasks, tasks.tasks[1:], strict=False))
    assert make_car_tasks(load_scene("arena"), 3).tasks == tasks.tasks[:3]
    train = make_car_tasks(load_scene("arena"), 3, split="train")
    assert not {t.goal for t in train.tasks} & {t.goal for t in tasks.tasks}
    points = make_car_tasks(load_scene("arena"), 3, targets="points")
    assert [len(t.goal) for t in points.tasks] == [2, 2, 2]


def test_task_files_are_checked(tasks, tmp_path):
    path = tmp_path / "tasks.json"
    save(tasks, path)
    assert load(path, load_scene("arena")) == tasks
    with pytest.raises(InputError, match="scene_hash"):
        load(path, load_scene("depot"))
    changed = json.loads(path.read_text())
    changed["tasks"][0]["goal"][0] += 0.5
    path.write_text(json.dumps(changed))
    with pytest.raises(InputError, match="hash"):
        load(path)
    path.write_text("{")
    with pytest.raises(InputError, match="JSON"):
        load(path)
