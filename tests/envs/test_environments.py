"""Test every registered environment: both checkers, seeds, pickling, videos, workers, documentation."""

import pickle
import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tests.envs.conventions.drawn_actions import drawn_action, zero_action
from tests.helpers.paths import CHECKOUT
from vssm_gym.envs.registration import ENVIRONMENTS
from vssm_gym.errors import InputError

IDS = sorted(name for name in ENVIRONMENTS if "WorldModel" not in name)  # those of a simulated scene
ENDED_BY_ACTIONS = [name for name in IDS if name != "vssm_gym/CarNav-v0"]  # has to arrive: test_carnav.py
ALWAYS = ("collision", "control")  # what every info holds


def make(name: str, **keywords) -> gym.Env:
    small = {} if "LidarMaze" in name else {"camera": {"width": 32, "height": 24}}
    return gym.make(name, **small | keywords)


def rollout(env: gym.Env, seed: int, steps: int = 8) -> list[bytes]:
    """Return all outputs of the environment, in steps of random actions."""
    observation, info = env.reset(seed=seed)
    rng, said = np.random.default_rng(0), []
    for _ in range(steps):
        said += [observation[key].tobytes() for key in sorted(observation)]
        said += [np.asarray(info[key]).tobytes() for key in ALWAYS]
        observation, reward, terminated, truncated, info = env.step(drawn_action(env, rng))
        said.append(repr((float(reward), bool(terminated), bool(truncated))).encode())
        if terminated or truncated:
            break
    return said


@pytest.mark.parametrize("name", IDS)
def test_gymnasium_accepts_it(name):
    pytest.importorskip("pygame", reason="the checker opens a window: the human extra is not installed")
    env = make(name, render_mode="rgb_array").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Actions in SI units are not in [-1, 1]: advice for networks, not a fault.
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")
        check_env(env, skip_render_check=False)
    env.close()


@pytest.mark.parametrize("name", IDS)
def test_captions_lie_below_the_picture(name):
    """Observations and pictures are the same with and without them; all pictures of an episode have one size."""
    plain, written = (make(name, render_mode="rgb_array", captions=captions) for captions in (False, True))
    (one, _), (other, _) = (env.reset(seed=0) for env in (plain, written))
    sizes = set()
    action = zero_action(plain.action_space)
    for _ in range(3):
        for key in one:
            np.testing.assert_array_equal(one[key], other[key])
        picture, frame = plain.render(), written.render()
        np.testing.assert_array_equal(frame[: len(picture)], picture)
        strip = frame[len(picture) :]
        assert len(np.unique(strip.reshape(-1, 3), axis=0)) > 10  # letters have soft edges
        sizes.add(frame.shape)
        one, other = plain.step(action)[0], written.step(action)[0]
    assert len(sizes) == 1
    total = written.unwrapped.tally
    assert total.steps == 3 and total.total != 0.0


@pytest.mark.parametrize("name", IDS)
def test_escape_closes_the_window_and_ends_the_program(name, monkeypatch):
    pygame = pytest.importorskip("pygame", reason="the human extra is not installed")
    monkeypatch.setattr("vssm_gym.envs.rendering.window.time.sleep", lambda seconds: None)
    env = make(name, render_mode="human")
    assert not pygame.display.get_init()  # it opens with the first picture
    env.reset(seed=0)
    written = make(name, render_mode="rgb_array", captions=True)
    written.reset(seed=0)
    shown = pygame.surfarray.array3d(pygame.display.get_surface()).swapaxes(0, 1)
    np.testing.assert_array_equal(shown, written.render())
    action = zero_action(env.action_space)
    env.step(action)
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))
    with pytest.raises(SystemExit) as ended:
        env.step(action)
    assert ended.value.code == 0 and not pygame.display.get_init()
    with pytest.raises(gym.error.ClosedEnvironmentError):
        env.step(action)


@pytest.mark.parametrize("name", IDS)
def test_options_and_use_after_close_are_refused(name):
    env = make(name).unwrapped
    for options in (5, "task", [1], np.zeros(3), {"no such key": 1}, {1: 2, "x": 3}):
        with pytest.raises(InputError, match="reset: options: expected") as refused:
            env.reset(seed=0, options=options)
        assert str(refused.value).isprintable()
    env.reset(seed=0)
    env.close()
    env.close()
    for use in (env.reset, lambda: env.step(env.action_space.sample())):
        with pytest.raises(gym.error.ClosedEnvironmentError):
            use()


@pytest.mark.parametrize("name", IDS)
def test_stable_baselines_accepts_it(name):
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason="the rl extra is not installed")
    with warnings.catch_warnings():
        # It would rather have square images above 36 pixels and actions in [-1, 1]: advice for its own networks.
        warnings.filterwarnings("ignore", category=UserWarning)
        checker.check_env(make(name))


@pytest.mark.parametrize("name", IDS)
def test_the_same_seed_gives_the_same_bytes(name):
    one, other = make(name, noise="high"), make(name, noise="high")
    first = rollout(one, 3)
    assert rollout(other, 3) == first
    assert rollout(one, 3) == first  # and again, in the same environment
    assert rollout(one, 4) != first


@pytest.mark.parametrize("name", IDS)
def test_a_pickled_environment_goes_on(name):
    env = make(name).unwrapped
    env.reset(seed=1)
    action = drawn_action(env, np.random.default_rng(0))
    env.step(action)
    copy = pickle.loads(pickle.dumps(env))
    for _ in range(3):
        ours, theirs = env.step(action), copy.step(action)
        for key in ours[0]:
            np.testing.assert_array_equal(ours[0][key], theirs[0][key])
        assert ours[1:4] == theirs[1:4]


@pytest.mark.parametrize("name", IDS)
def test_observations_and_infos_are_as_documented(name):
    env = make(name)
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert "start_pose" in info
    observation, _, _, _, info = env.step(zero_action(env.action_space))
    assert env.observation_space.contains(observation)
    assert set(ALWAYS) <= set(info)
    assert not any("pose" in key for key in observation) or name == "vssm_gym/Explore-v0"


@pytest.mark.parametrize("name", IDS)
def test_the_native_vector_environment_seeds_like_the_single_ones(name):
    small = {} if "LidarMaze" in name else {"camera": {"width": 32, "height": 24}}
    vector = gym.make_vec(name, num_envs=2, **small)
    observations, _ = vector.reset(seed=5)
    for i in range(2):
        alone = make(name).reset(seed=5 + i)[0]
        for key, value in alone.items():
            np.testing.assert_array_equal(observations[key][i], value)
    vector.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", IDS)
def test_spawned_workers_run_it(name):
    small = {} if "LidarMaze" in name else {"camera": {"width": 32, "height": 24}}
    env = gym.make_vec(name, num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"}, **small)
    native = gym.make_vec(name, num_envs=2, **small)
    theirs, ours = env.reset(seed=2)[0], native.reset(seed=2)[0]
    for key in ours:
        np.testing.assert_array_equal(theirs[key], ours[key])
    env.close()
    native.close()


@pytest.mark.slow
@pytest.mark.parametrize("name", IDS)
def test_a_video_of_it_can_be_recorded(name, tmp_path):
    pytest.importorskip("moviepy", reason="Gymnasium's RecordVideo needs moviepy")
    env = gym.wrappers.RecordVideo(make(name, render_mode="rgb_array", max_episode_steps=5), str(tmp_path))
    env.reset(seed=0)
    done = False
    while not done:
        _, _, terminated, truncated, _ = env.step(zero_action(env.action_space))
        done = terminated or truncated
    env.close()
    (video,) = tmp_path.glob("*.mp4")
    assert video.stat().st_size > 1000


@pytest.mark.parametrize("name", IDS)
def test_it_has_a_page_with_its_tables(name):
    page = CHECKOUT / "docs" / "envs" / f"{ENVIRONMENTS[name].vector.rpartition(':')[2]}.md"
    text = page.read_text()
    assert re.search(rf"^#+ `{name}`$", text, re.MULTILINE)
    for table in ("Observation", "Action", "`info`"):
        assert f"{table}" in text, table
    assert "../images/" in text


def ends_now(env: gym.Env) -> None:
    """Let the environment's next report be an episode's last one."""
    reported = env.report

    def report():
        del env.report
        observation, reward, _, truncated, info = reported()
        return observation, reward, True, truncated, info

    env.report = report


@pytest.mark.parametrize("name", ENDED_BY_ACTIONS)
def test_no_step_before_a_reset_nor_after_an_episode(name):
    env = make(name).unwrapped
    action = zero_action(env.action_space)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(action)
    env.reset(seed=0)
    env.step(action)
    ends_now(env)
    assert env.step(action)[2]
    for _ in range(2):
        with pytest.raises(gym.error.ResetNeeded):
            env.step(action)
    env.reset()
    env.step(action)


@pytest.mark.parametrize("name", ENDED_BY_ACTIONS)
def test_a_vector_environment_goes_on_after_an_episode(name):
    small = {} if "LidarMaze" in name else {"camera": {"width": 32, "height": 24}}
    vector = gym.make_vec(name, num_envs=1, **small)
    vector.reset(seed=0)
    actions = zero_action(vector.action_space)
    ends_now(vector.envs[0])
    assert vector.step(actions)[2].all()
    _, reward, terminated, _, _ = vector.step(actions)  # NEXT_STEP: this is the reset
    assert reward[0] == 0.0 and not terminated[0]
    vector.step(actions)
    vector.close()


@pytest.mark.parametrize("name", IDS)
def test_an_unknown_keyword_names_the_environment_and_its_keywords(name):
    title = ENVIRONMENTS[name].env.rpartition(":")[2].removesuffix("Env")
    for build in (gym.make, gym.make_vec):
        expected = rf"^{title}: foo: expected one of its keywords: scene, .*render_mode"
        with pytest.raises(InputError, match=expected) as error:
            build(name, foo=1)
        assert "simulation" not in error.value.expected and "\n" not in str(error.value)
