"""Test the protocol on every registered agent, and that navigators reach their goals by short paths or report why not.

The world here is a floor plan and the noisy kinematics of the holonomic robot (eq. T1). The
agents' map is a learned map of that plan.
"""

import dataclasses
import inspect
import math
from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import shapely

from tests.helpers.box_rooms import free_space
from tests.helpers.planning_worlds import voxel_map
from vssm_gym.agents import registry
from vssm_gym.agents.base import ANY_TASK, Agent, AgentContext, Decision
from vssm_gym.agents.navigation.dead_reckoning import DeadReckoningAgent
from vssm_gym.agents.navigation.oracle import OracleAgent
from vssm_gym.agents.navigation.random import RandomAgent, RandomConfig
from vssm_gym.agents.registry import AGENTS, make_agent
from vssm_gym.agents.renamed import RENAMED
from vssm_gym.agents.shared.localization import FilteredPose, TruePose
from vssm_gym.agents.shared.navigation_config import NavigationConfig
from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot, execute
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.errors import InputError
from vssm_gym.eval.metrics.pose_calibration import pose_calibration
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.maps.pose_errors import PoseErrors
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.transition import MotionNoise, Planar
from vssm_gym.planning.grid_search.astar import plan
from vssm_gym.planning.planners import PLANNERS

FLOOR = shapely.box(0.0, 0.0, 5.0, 3.0)
WALL = shapely.box(2.45, 0.0, 2.55, 2.1)  # leaves a way of 0.9 m between two rooms
TABLE = shapely.box(3.4, 0.9, 4.0, 1.5)
ROBOT = HolonomicRobot()
CAMERA = Camera.from_hfov(64, 48, math.radians(90.0))
LOW = NOISE_LEVELS["low"]
SEES = ["astar", "no_map"]  # agents that need images
# Of the others: tests/agents/car/test_car_agents.py, tests/agents/test_explorers.py.
ON_FOOT = [
    name for name, agent in AGENTS.items() if agent.robot == "holonomic" and agent.task in ("pointgoal", ANY_TASK)
]


@pytest.fixture(scope="module")
def learned() -> VoxelMap:
    return voxel_map(FLOOR, [(WALL, 0.0, 1.0), (TABLE, 0.0, 0.7)])


def context(learned: VoxelMap | None, start: np.ndarray) -> AgentContext:
    return AgentContext(
        K=CAMERA.K,
        camera=(CAMERA.width, CAMERA.height),
        T_body_cam=ROBOT.T_body_cam,
        limits=ROBOT.limits,
        dt=ROBOT.dt,
        map=learned,
        start_pose=np.asarray(start),
        body_length=ROBOT.body_length,
        success_radius=0.4,
        noise=(LOW.turn, LOW.step),
        transition=Planar(MotionNoise(LOW.turn, LOW.step)),
    )


def observe(planar: np.ndarray, goal: np.ndarray, learned: VoxelMap | None) -> dict[str, np.ndarray]:
    """Return the robot's observation: an image of the map where one is given, else a blank one."""
    rgb = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    depth = np.zeros((CAMERA.height, CAMERA.width), np.float32)
    if learned is not None:
        T_world_cam = jnp.asarray(planar_to_matrix(planar) @ ROBOT.T_body_cam, jnp.float32)
        image = emission.render(learned, T_world_cam, CAMERA)
        rgb, depth = np.round(np.asarray(image.rgb) * 255.0).astype(np.uint8), np.asarray(image.depth)
    return {"rgb": rgb, "depth": depth, "goal": goal.astype(np.float32), "pose": planar.astype(np.float32)}


@dataclasses.dataclass
class Run:
    """Hold a finished drive."""

    decisions: list[Decision]
    poses: np.ndarray  # (steps + 1, 3), the truth
    stopped: bool

    @property
    def driven(self) -> float:
        return float(np.linalg.norm(np.diff(self.poses[:, :2], axis=0), axis=1).sum())

    def away(self, goal: np.ndarray) -> float:
        return float(np.linalg.norm(self.poses[-1, :2] - goal))


def drive(
    agent: Agent,
    learned: VoxelMap | None,
    start: np.ndarray,
    goal: np.ndarray,
    seed: int = 0,
    steps: int = 200,
    seen: VoxelMap | None = None,
    blocked: Callable[[np.ndarray], bool] | None = None,
) -> Run:
    """Run an agent with low execution noise; a step that would end in a ``blocked`` place moves nothing."""
    rng, planar = np.random.default_rng(seed), np.asarray(start, np.float64)
    observation = observe(planar, goal, seen)
    agent.reset(context(learned, planar), observation, seed)
    decisions, poses = [], [planar]
    for _ in range(steps):
        decision = agent.act(observation)
        decisions.append(decision)
        if decision.action[3] > 0.5:
            break
        moved = execute(planar, decision.action[:3], LOW, rng)
        if blocked is not None and blocked(moved[:2]):
            moved[:2] = planar[:2]
        planar = moved
        poses.append(planar)
        observation = observe(planar, goal, seen)
    return Run(decisions, np.array(poses), bool(decisions[-1].action[3] > 0.5))


@pytest.mark.parametrize("name", AGENTS)
def test_protocol(name):
    agent = AGENTS[name]()
    assert isinstance(agent, Agent)
    assert agent.name == name
    assert {type(agent.needs_pose), type(agent.needs_map)} == {bool}
    assert agent.task in ("pointgoal", "imagegoal", "explore", ANY_TASK)
    # Whatever the environment's info holds, there is no way to hand it over.
    assert list(inspect.signature(agent.act).parameters) == ["observation"]
    assert list(inspect.signature(agent.reset).parameters) == ["context", "observation", "seed"]


def test_only_bounds_read_the_pose():
    assert [name for name in ON_FOOT if AGENTS[name].needs_pose] == ["oracle", "slam_nav_true_pose"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_FOOT)
def test_same_seed_same_actions(name, learned):
    """Actions repeat between two objects, and after an episode that ran before; they stay within the limits."""
    start, goal = np.array([0.6, 0.6, 0.3]), np.array([4.4, 0.5])
    agent, seen = AGENTS[name](), learned if name in SEES else None
    runs = [drive(a, learned, start, goal, seed=3, steps=10, seen=seen) for a in (agent, AGENTS[name](), agent)]
    actions = [np.array([d.action for d in run.decisions]) for run in runs]
    assert actions[0].dtype == np.float32
    assert np.array_equal(actions[0], actions[1])
    assert np.array_equal(actions[0], actions[2])
    low, high = np.array([*-ROBOT.limits[:2], 0.0, 0.0]), np.array([*ROBOT.limits, 1.0])
    assert np.all((actions[0] >= low - 1e-6) & (actions[0] <= high + 1e-6))
    for decision in runs[0].decisions:
        assert decision.status
        assert decision.pose is None or decision.pose.shape == (3,)
        assert set(decision.latency) <= {"tracking", "planning", "control"}


@pytest.mark.parametrize("name", [name for name in ON_FOOT if not AGENTS[name].needs_pose])
def test_the_true_pose_changes_nothing(name, learned):
    """Agents that may not know the pose do the same when the observation holds a wrong one."""
    start, goal = np.array([0.6, 0.6, 0.3]), np.array([4.4, 0.5])
    actions = []
    for lie in (0.0, 1.0):
        agent = AGENTS[name]()
        observation = observe(start, goal, learned if name in SEES else None)
        observation["pose"] = observation["pose"] + np.float32(lie)
        agent.reset(context(learned, start), observation, 0)
        actions.append([agent.act(observation).action for _ in range(4)])
    assert np.array_equal(actions[0], actions[1])


def test_the_random_agent_stops_with_its_configured_probability(learned):
    agent = RandomAgent(RandomConfig(stop_probability=0.1))
    start, goal = np.array([0.6, 0.6, 0.0]), np.array([4.4, 0.5])
    lengths = [len(drive(agent, None, start, goal, seed=s).decisions) for s in range(200)]
    assert np.mean(lengths) == pytest.approx(10.0, abs=3.0 * 9.5 / math.sqrt(200))
    assert len({tuple(drive(agent, None, start, goal, seed=s).decisions[0].action) for s in range(5)}) == 5


def test_the_oracle_takes_the_shortest_path(learned):
    """At low noise every goal in both rooms is reached, with a mean SPL above 0.95 by the exact geodesics."""
    space = free_space([WALL, TABLE], ROBOT.radius, FLOOR)
    geodesics, rng = Geodesics(space), np.random.default_rng(5)
    agent, spl = OracleAgent(), []
    while len(spl) < 12:
        start, goal = space.sample(rng, 2)
        shortest = geodesics.length(start, goal, 0.4)
        if shortest < 1.0:
            continue
        planar = np.array([*start, rng.uniform(-math.pi, math.pi)])
        run = drive(agent, learned, planar, goal, seed=len(spl), blocked=lambda xy: not space.contains(xy))
        assert run.stopped
        assert run.away(goal) <= 0.4
        spl.append(shortest / max(shortest, run.driven))
    assert np.mean(spl) > 0.95


def test_a_new_goal_is_a_new_task(learned):
    """Chained tasks: after a stop the goal in the observation changes and the agent drives on without a reset."""
    agent, goals = OracleAgent(), [np.array([1.8, 2.4]), np.array([4.4, 2.4]), np.array([0.6, 0.6])]
    planar, rng = np.array([0.6, 0.6, 0.0]), np.random.default_rng(0)
    observation = observe(planar, goals[0], None)
    agent.reset(context(learned, planar), observation, 0)
    for goal in goals:
        for _ in range(120):
            decision = agent.act(observe(planar, goal, None))
            if decision.action[3] > 0.5:
                break
            planar = execute(planar, decision.action[:3], LOW, rng)
        assert decision.action[3] > 0.5
        assert np.array_equal(decision.action[:3], np.zeros(3))
        assert np.linalg.norm(planar[:2] - goal) <= 0.4


@pytest.mark.parametrize("name", ["oracle", "dead_reckoning"])
def test_the_first_step_plans_and_is_timed(name, learned):
    """Planning in ``reset`` warms up only: the search that leads the robot is part of the first step's latency."""
    searched = []

    def counted(*arguments, **keywords):
        searched.append(plan(*arguments, **keywords))
        return searched[-1]

    agent, start = AGENTS[name](NavigationConfig(planner=counted)), np.array([0.6, 0.6, 0.3])
    observation = observe(start, np.array([4.4, 0.5]), None)
    agent.reset(context(learned, start), observation, 0)
    counts = [len(searched)]
    for _ in range(3):
        decision = agent.act(observation)
        counts.append(len(searched))
        if len(counts) == 2:
            assert decision.latency["planning"] >= sum(result.seconds for result in searched[counts[0] :])
    assert counts[0] < counts[1] == counts[2] == counts[3]


@pytest.mark.parametrize("name", PLANNERS)
def test_any_planner_leads_to_the_goal(name, learned):
    """The agent calls the configured planner and follows its paths to the goal."""
    asked = []

    def counted(*arguments, **keywords):
        asked.append(PLANNERS[name](*arguments, **keywords))
        return asked[-1]

    start, goal = np.array([0.6, 0.6, 0.3]), np.array([4.4, 0.5])
    by_name = drive(OracleAgent(NavigationConfig(planner=name)), learned, start, goal)
    by_object = drive(OracleAgent(NavigationConfig(planner=counted)), learned, start, goal)
    assert np.array_equal(by_name.poses, by_object.poses)
    assert asked
    assert by_name.stopped
    assert by_name.away(goal) <= 0.4
    shortest = Geodesics(free_space([WALL, TABLE], ROBOT.radius, FLOOR)).length(start[:2], goal, 0.4)
    assert by_name.driven <= 1.1 * shortest


def test_an_unmapped_obstacle_is_avoided(learned):
    """The robot detects an obstacle that the map does not hold, drives around it, and still arrives."""
    start, goal, box = np.array([0.5, 0.5, 0.0]), np.array([2.0, 0.5]), shapely.box(1.1, 0.3, 1.2, 0.7).buffer(0.1)
    run = drive(OracleAgent(), learned, start, goal, blocked=lambda xy: box.contains(shapely.Point(xy)))
    assert run.stopped
    assert run.away(goal) <= 0.4
    assert run.decisions[-1].responses["plans around what holds it"] >= 1


def test_a_missing_path_is_reported_and_ends_the_episode():
    """Before a wall from side to side the agent turns around once, then stops and reports that there is no path."""
    divided = voxel_map(FLOOR, [(shapely.box(2.45, 0.0, 2.55, 3.0), 0.0, 1.0)])
    run = drive(OracleAgent(), divided, np.array([0.6, 0.6, 0.0]), np.array([4.4, 0.6]), steps=40)
    assert run.stopped
    turned = np.abs(np.diff(np.unwrap(run.poses[:, 2]))).sum()
    assert 0.9 * 2.0 * math.pi < turned < 1.5 * 2.0 * math.pi
    assert "gave up: no path" in run.decisions[-1].status
    assert np.allclose(run.poses[:, :2], run.poses[0, :2])


def test_a_goal_in_an_obstacle_is_approached(learned):
    """The goal itself is in the table, but the success region around it is not all blocked."""
    goal = np.array([3.5, 1.2])
    run = drive(OracleAgent(), learned, np.array([2.9, 0.5, 0.0]), goal)
    assert run.stopped
    assert run.away(goal) <= 0.4


def test_an_uncertain_agent_drives_deeper_into_the_success_region():
    """The larger the estimate's deviation, the deeper inside the success region the agent drives before it stops."""
    learned = voxel_map(FLOOR, [])
    goal, ends = np.array([3.5, 1.5]), []
    for sigmas in (0.0, 2.5):
        agent = DeadReckoningAgent(NavigationConfig(stop_sigmas=sigmas))
        run = drive(agent, learned, np.array([0.5, 1.5, 0.0]), goal)
        assert run.stopped
        ends.append(np.linalg.norm(run.decisions[-1].pose[:2] - goal))
    assert 0.3 < ends[0] <= 0.4
    assert ends[1] < 0.25


def noise_image(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return an image of noise, which dead reckoning does not use."""
    rgb = rng.integers(0, 256, (CAMERA.height, CAMERA.width, 3), np.uint8)
    return {"rgb": rgb, "depth": rng.uniform(0.3, 5.0, (CAMERA.height, CAMERA.width)).astype(np.float32)}


def test_dead_reckoning_is_exact_without_noise():
    planar, rng = np.array([1.0, 2.0, 0.5]), np.random.default_rng(0)
    localizer = FilteredPose("dead_reckoning")
    exact = replace(context(None, planar), noise=(0.0, 0.0), transition=Planar(MotionNoise(0.0, 0.0)))
    localizer.reset(exact, noise_image(rng))
    for _ in range(50):
        command = rng.uniform(-ROBOT.limits * [1.0, 1.0, 0.0], ROBOT.limits)
        planar = execute(planar, command, NOISE_LEVELS["none"], rng)
        estimate = localizer.update(command, noise_image(rng))
    assert np.allclose(estimate.planar, planar, atol=1e-4)


def test_dead_reckoning_states_its_error_correctly():
    """Its standard deviations equal those of 2000 noisy drives of the same 30 commands."""
    start = np.array([0.0, 0.0, 0.4])
    commands = [(0.1, 0.0, 0.0) if k % 3 == 0 else (0.0, 0.02, 0.12) for k in range(30)]
    localizer, rng = FilteredPose("dead_reckoning"), np.random.default_rng(0)
    localizer.reset(context(None, start), noise_image(rng))
    for command in commands:
        estimate = localizer.update(np.array(command), noise_image(rng))
    ends = []
    for _ in range(2000):
        planar = start
        for command in commands:
            planar = execute(planar, np.array(command), LOW, rng)
        ends.append(planar)
    assert np.allclose(estimate.std, np.std(ends, axis=0), rtol=0.1)
    # In the body frame, where the error along the way is not that across it: NEES / 3 is 1 of drives as these.
    found = pose_calibration(
        *(np.tile(part, (2000, *[1] * part.ndim)) for part in (estimate.planar, estimate.covariance)), np.array(ends)
    )
    assert found["nees"] == pytest.approx(1.0, abs=0.1)
    assert found["in_95"] == pytest.approx(0.95, abs=0.02)


@pytest.mark.slow
def test_the_error_of_a_map_is_in_the_stated_covariance(learned):
    """A map whose one keyframe is off by 10 cm along x and 2 cm along y, for a robot that looks along y."""
    start, command = np.array([1.0, 1.0, math.pi / 2.0]), np.array([0.05, 0.0, 0.0])
    T = planar_to_matrix(start) @ ROBOT.T_body_cam
    errors = PoseErrors.of(T[None], np.diag([0.1**2, 0.02**2, 0.0, 0.0, 0.0, 0.0])[None], CAMERA)
    stated = []
    for m in (learned, replace(learned, pose_errors=errors)):
        localizer = FilteredPose("tracker")
        localizer.reset(context(m, start), observe(start, start[:2], m))
        turned = np.add(start, [0.0, 0.0, 0.05])
        stated.append(localizer.update(command, observe(turned, turned[:2], m)))
    assert stated[0].std == pytest.approx(stated[1].std)  # against the map nothing has changed
    turn = stated[1].planar[2] - math.pi / 2.0
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    added = R.T @ np.diag([0.02**2, 0.1**2]) @ R  # forward is y, and left is -x
    np.testing.assert_allclose((stated[1].covariance - stated[0].covariance)[:2, :2], added, atol=1e-5)


def test_missing_map_and_missing_pose(learned):
    start, goal = np.array([0.6, 0.6, 0.0]), np.array([4.4, 0.5])
    blank = observe(start, goal, None)
    with pytest.raises(InputError, match="map"):
        DeadReckoningAgent().reset(context(None, start), blank, 0)
    with pytest.raises(InputError, match="map"):
        FilteredPose("tracker").reset(context(None, start), blank)
    del blank["pose"]
    with pytest.raises(InputError, match="observe_pose"):
        TruePose().reset(context(learned, start), blank)


@pytest.mark.parametrize("name", SEES)
def test_agents_with_a_camera_arrive(name, learned):
    """They drive by images rendered from the map, through the passage into the other room."""
    start, goal = np.array([1.0, 1.0, 1.0]), np.array([4.3, 0.6])
    run = drive(AGENTS[name](), learned, start, goal, seen=learned)
    errors = [np.linalg.norm(d.pose[:2] - p[:2]) for d, p in zip(run.decisions, run.poses, strict=True)]
    assert run.stopped
    assert run.away(goal) <= 0.4
    assert np.max(errors) < 0.1


@pytest.mark.parametrize("former", RENAMED)
def test_a_former_name_is_refused_with_the_present_one(former):
    with pytest.raises(InputError, match=f"expected '{RENAMED[former]}', the present name .* found '{former}'"):
        make_agent(former)


def test_an_unknown_agent_is_refused_and_the_known_ones_are_listed():
    with pytest.raises(InputError, match=r"expected one of astar, .*; found 'nobody'"):
        make_agent("nobody")


def test_an_agent_of_a_program_is_registered_by_its_name(monkeypatch):
    monkeypatch.setattr(registry, "AGENTS", dict(registry.AGENTS))

    class Mine(registry.AGENTS["random"]):
        name = "mine"

    assert registry.register_agent(Mine) is Mine
    assert isinstance(registry.make_agent("mine"), Mine)
    assert registry.register_agent(Mine) is Mine  # a worker process imports the program again

    class Other(registry.AGENTS["random"]):
        name = "astar"

    with pytest.raises(InputError, match="no other agent"):
        registry.register_agent(Other)
    assert registry.AGENTS["astar"] is not Other
