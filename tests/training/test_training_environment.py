"""Test what a training observes and does: features, last commands, actions, costs, and errors of a tracked pose."""

import numpy as np

from tests.helpers.training.corridor import Corridor
from vssm_gym.agents.policy.features import LAST_COMMANDS, features
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.training.config import EnvironmentSettings
from vssm_gym.training.environment import BODY, PolicyView, commands, make_observing


def test_a_training_without_a_map_observes_what_the_training_in_a_map_does():
    """Apart from the pose: PointNavGPS gives the scan and the goal of a wrapped PointNav with an observed pose."""
    shared = {"scene": "fern", "num_envs": 2, "noise": "mid", "max_episode_steps": 20}
    gps = make_observing(EnvironmentSettings(id="vssm_gym/PointNavGPS-v0", **shared))
    exact = make_observing(EnvironmentSettings(id="vssm_gym/PointNav-v0", **shared))
    seen, expected = gps.reset(seed=3)[0], exact.reset(seed=3)[0]
    for _ in range(4):
        np.testing.assert_array_equal(seen["scan"], expected["scan"])
        np.testing.assert_allclose(seen["goal"], expected["goal"], atol=1e-4)
        driven = commands(np.array([[0.2, 0.0, 1.0], [-1.0, 0.5, 0.0]]))
        seen, expected = gps.step(driven)[0], exact.step(driven)[0]


def test_actions_span_the_robots_commands():
    low, middle, high = commands(np.array([[-1.0, -1.0, -1.0], [0.0, 0.0, 0.0], [7.0, 1.0, 1.0]]))
    np.testing.assert_allclose(low, [*BODY.low, 0.0], atol=1e-6)
    np.testing.assert_allclose(middle, [0.0, 0.0, 0.08, 0.0], atol=1e-6)
    np.testing.assert_allclose(high, [*BODY.high, 0.0], atol=1e-6)


def test_a_view_has_features_and_marks_arrivals():
    env = PolicyView(Corridor(2), ("scan", "goal"))
    first, _ = env.reset()
    np.testing.assert_array_equal(first, features(env.shown, ("scan", "goal")))
    assert env.single_observation_space.contains(first[0])
    actions = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], np.float32)
    infos = [env.step(actions)[-1] for _ in range(12)]
    assert infos[0] == {}
    assert infos[3]["is_success"].tolist() == [True, False] and infos[3]["_is_success"].tolist() == [True, False]
    assert infos[11]["_is_success"][1] and not infos[11]["is_success"][1]


def test_a_view_shows_the_last_commands_of_an_episode():
    """Newest first, as the environment gets them; none is left where an episode begins."""
    where = EnvironmentSettings(id="vssm_gym/PointNav-v0", scene="fern", num_envs=2, max_episode_steps=3)
    env = PolicyView(make_observing(where), ("goal", "commands"))
    env.reset(seed=0)
    rng, sent = np.random.default_rng(0), []
    for step in range(1, 7):
        actions = rng.uniform(-1.0, 1.0, (2, 3))
        sent = [commands(actions)[:, :3], *sent] if step != 4 else []  # the fourth step begins the next episode
        env.step(actions)
        expected = np.zeros((2, LAST_COMMANDS, 3))
        expected[:, : len(sent)] = np.stack(sent, axis=1)[:, :LAST_COMMANDS] if sent else 0.0
        np.testing.assert_allclose(env.shown["commands"], expected, atol=1e-6)
    env.reset(options={"reset_mask": np.array([True, False])})
    assert (env.shown["commands"][0] == 0.0).all() and (env.shown["commands"][1] != 0.0).any()
    env.close()


def test_collisions_have_the_configured_cost():
    free, dear = (PolicyView(Corridor(2), ("goal",), cost) for cost in (0.0, 0.25))
    rewards = []
    for env in (free, dear):
        env.reset()
        rewards.append(env.step(np.zeros((2, 3), np.float32))[1])
    np.testing.assert_allclose(rewards[0] - rewards[1], [0.0, 0.25])


def test_tracking_errors_are_added_to_the_simulators_poses():
    """They have the configured standard deviations, from an exact start; the goal is relative to the erroneous pose."""
    where = {"id": "vssm_gym/PointNav-v0", "scene": "oak", "num_envs": 4, "max_episode_steps": 40}
    exact, tracked = (
        make_observing(EnvironmentSettings(**where, pose_std=std)) for std in ((0.0, 0.0, 0.0), (0.02, 0.04, 0.01))
    )
    true, tracked_ = (env.reset(seed=0)[0] for env in (exact, tracked))
    np.testing.assert_allclose(tracked_["pose"], true["pose"], atol=1e-6)
    errors, action = [], np.tile(np.array([0.1, 0.0, 0.0, 0.0], np.float32), (4, 1))
    for _ in range(80):
        true, tracked_ = (env.step(action)[0] for env in (exact, tracked))
        c, s = np.cos(true["pose"][:, 2]), np.sin(true["pose"][:, 2])
        dx, dy, turn = (tracked_["pose"] - true["pose"]).T
        errors.append(np.stack([c * dx + s * dy, c * dy - s * dx, wrap_angle(turn)], axis=-1))
    np.testing.assert_allclose(errors[40], 0.0, atol=1e-6)  # all episodes have restarted
    assert np.abs(tracked_["goal"] - true["goal"]).max() > 1e-3
    np.testing.assert_allclose(np.std(np.concatenate(errors), axis=0), [0.02, 0.04, 0.01], rtol=0.3)
    for env in (exact, tracked):
        env.close()
