"""Test what varies between episodes: its ranges, its stream, and that nothing else changes."""

import pickle

import gymnasium as gym
import numpy as np
import pytest

import vssm_gym  # noqa: F401  (registers the ids)
from tests.envs.conventions.drawn_actions import drawn_action
from tests.helpers.box_rooms import furniture, two_rooms
from vssm_gym.envs.conventions.randomization import Randomization, between_noises, light_table
from vssm_gym.envs.robots import NOISE_LEVELS
from vssm_gym.errors import InputError

POINT = "vssm_gym/PointNav-v0"
HOMES = [two_rooms(), two_rooms(pieces=(furniture("table", (1.0, 3.0, 0.3), (0.6, 0.5, 0.6)),))]
ALL = {
    "scene": HOMES,
    "noise": ["none", "high"],
    "camera_height": [0.2, 0.5],
    "hfov": [1.0, 2.0],
    "light": [0.3, 1.5],
}
NOTHING = {"noise": ["mid", "mid"], "camera_height": [0.4, 0.4], "hfov": [np.pi / 2, np.pi / 2], "light": [1, 1]}


def settings(**keywords) -> dict:
    fixed = {"scene": HOMES[0], "camera": {"width": 16, "height": 12}, "noise": "mid", "sensor_noise": "kinect"}
    return fixed | {"sensors": ["lidar", "bumper"]} | keywords


def make(name: str = POINT, **keywords) -> gym.Env:
    return gym.make(name, **settings(**keywords))


def episodes(env: gym.Env, count: int = 3, steps: int = 3) -> list[bytes]:
    """Return what the environment shows in short episodes, with the cameras' poses and intrinsics."""
    rng, said = np.random.default_rng(0), []
    for episode in range(count):
        observation, info = env.reset(seed=3 if episode == 0 else None)
        for _ in range(steps):
            said += [observation[key].tobytes() for key in sorted(observation)]
            said += [info[key].tobytes() for key in ("T_world_cam", "K")]
            observation, reward, *_, info = env.step(drawn_action(env, rng))
            said.append(np.float64(reward).tobytes())
    return said


@pytest.mark.parametrize("name", ["PointNav", "ImageNav", "Explore"])
def test_the_same_seed_gives_the_same_bytes_also_in_a_copy(name):
    varied = {key: value for key, value in ALL.items() if name != "Explore" or key != "camera_height"}
    env, other = (make(f"vssm_gym/{name}-v0", randomize=varied) for _ in range(2))
    first = episodes(env)
    assert episodes(other) == first
    assert episodes(env) == first
    one, two = env.unwrapped, pickle.loads(pickle.dumps(env.unwrapped))
    for _ in range(3):  # in several scenes
        a, b = one.reset()[0], two.reset()[0]
        for key in a:
            np.testing.assert_array_equal(a[key], b[key], err_msg=key)


def test_a_range_without_width_changes_no_byte():
    """The draws have a stream of their own: tasks, noise and images are those without the keyword."""
    assert episodes(make(randomize=NOTHING)) == episodes(make())
    assert episodes(make(randomize=ALL)) != episodes(make())


def test_vectors_equal_single_environments():
    keywords = settings(randomize=ALL, max_episode_steps=2)
    ours = gym.make_vec(POINT, num_envs=2, threads=2, **keywords)
    oracle = gym.make_vec(POINT, num_envs=2, vectorization_mode="sync", **keywords)
    ours.action_space.seed(1)
    (seen, _), (expected, _) = ours.reset(seed=5), oracle.reset(seed=5)
    for _ in range(9):
        for key in expected:
            np.testing.assert_array_equal(seen[key], expected[key], err_msg=key)
        actions = ours.action_space.sample()
        actions[:, -1] = 0.0
        seen, expected = ours.step(actions)[0], oracle.step(actions)[0]
    ours.close()
    oracle.close()


def test_everything_varies_within_its_range():
    env = make(randomize=ALL).unwrapped
    drawn = {"scene": set(), "noise": [], "height": [], "hfov": []}
    env.reset(seed=0)
    for _ in range(12):
        _, info = env.reset()
        drawn["scene"].add(env.apartment.content_hash())
        assert info["task"].scene == env.apartment.name
        drawn["noise"].append(env.simulation.noise.turn / NOISE_LEVELS["high"].turn)
        drawn["height"].append(info["T_world_cam"][2, 3])
        drawn["hfov"].append(2.0 * np.arctan(0.5 * 16 / info["K"][0, 0]))
    assert len(drawn["scene"]) == 2
    for key, (low, high) in (("noise", (0.0, 1.0)), ("height", (0.2, 0.5)), ("hfov", (1.0, 2.0))):
        values = np.array(drawn[key])
        assert low - 1e-9 <= values.min() < values.max() <= high + 1e-9
        assert np.ptp(values) > 0.3 * (high - low), key


def test_the_field_of_view_height_and_light_are_in_the_image():
    """A camera of the drawn intrinsics at the drawn height sees the same depth, with colours under its own light."""
    varied = {"hfov": [1.2, 1.2], "camera_height": [0.25, 0.25], "light": [0.5, 0.5]}
    quiet = {"sensor_noise": "none", "sensors": []}
    seen, info = make(randomize=varied, **quiet).reset(seed=1)
    narrow = make(camera={"width": 16, "height": 12, "hfov": 1.2}, **quiet).unwrapped
    rgb, depth = narrow.simulation.renderer.render(info["T_world_cam"])
    assert info["T_world_cam"][2, 3] == pytest.approx(0.25)
    np.testing.assert_array_equal(seen["depth"], depth)
    np.testing.assert_array_equal(seen["rgb"], light_table(0.5)[rgb])


def test_scenes_are_built_once():
    """Episodes that return to a scene find its renderer, its free space and its simulator as they were."""
    env = make(randomize={"scene": HOMES}).unwrapped
    built: dict[str, set[tuple[int, ...]]] = {}
    env.reset(seed=0)
    for _ in range(10):
        env.reset()
        s = env.simulation
        parts = (id(s.renderer), id(s.scene_cache), id(s.world), id(s.scene_cache.sampler))
        built.setdefault(env.apartment.content_hash(), set()).add(parts)
    assert len(built) == 2 and all(len(parts) == 1 for parts in built.values())


def test_noise_between_two_levels_by_hand():
    half = between_noises(NOISE_LEVELS["none"], NOISE_LEVELS["mid"], 0.5)
    assert (half.turn, half.step) == (0.5 * NOISE_LEVELS["mid"].turn, 0.5 * NOISE_LEVELS["mid"].step)


def test_a_quantity_more_changes_no_other():
    rng = lambda: np.random.default_rng(0)
    one, both = Randomization(hfov=(1.0, 2.0)), Randomization(hfov=(1.0, 2.0), light=(0.5, 1.0))
    assert one.draw(rng()).hfov == both.draw(rng()).hfov
    assert one.draw(rng()).light is None


@pytest.mark.parametrize(
    ("randomize", "message"),
    [
        ({"sound": 1}, "environment: randomize: expected a Randomization, or a mapping of scene, noise"),
        (5, "randomize: expected"),
        ({"scene": "oak"}, "randomize: scene: expected a list of scenes"),
        ({"noise": "low"}, "randomize: noise: expected two noise levels"),
        ({"noise": ["low", "huge"]}, "noise"),
        ({"hfov": [2.0, 1.0]}, "randomize: hfov: expected two numbers, low <= high"),
        ({"hfov": [1.0, float("nan")]}, "hfov"),
        ({"light": [0.0, 1.0]}, "light"),
        ({"camera_height": [0.1, 0.9]}, "randomize: camera_height: expected heights within the robot"),
        ({"light": 2.0}, "light"),
    ],
)
def test_bad_ranges_are_refused(randomize, message):
    with pytest.raises(InputError, match=message):
        make(randomize=randomize)


def test_what_cannot_vary_is_refused():
    with pytest.raises(InputError, match="Explore: randomize: expected no camera_height"):
        make("vssm_gym/Explore-v0", randomize={"camera_height": [0.2, 0.3]})
    env = make(randomize={"scene": ["fern", "ivy"]})
    with pytest.raises(InputError, match="scene"):
        env.reset(seed=0, options={"task": make().unwrapped.sampler.task((0.5, 1.0, 0.0), (2.0, 1.0))})
