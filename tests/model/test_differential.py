"""Test differential drive: laws of its noisy wheels, the robot in an apartment, and the transition."""

import math

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import vssm_gym  # noqa: F401  (registers the environments)
from tests.helpers.box_rooms import two_rooms
from tests.inference import test_filters
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.robots.differential import NOISE_LEVELS, DifferentialRobot
from vssm_gym.envs.robots.differential import DifferentialExecutionNoise as Noise
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.inference.registry import filters_for
from vssm_gym.model.transition import PLANAR, DifferentialDrive, DifferentialNoise, GaussianBelief

ROBOT = DifferentialRobot()
START = np.array([0.4, -0.7, 2.9])  # near pi: turning left wraps

planars = st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(-math.pi, math.pi)).map(np.array)
# XLA flushes subnormal numbers to zero, and then nothing is commanded
travels = st.one_of(st.just(0.0), st.floats(-ROBOT.max_travel, ROBOT.max_travel, allow_subnormal=False))
commands = st.tuples(travels, travels).map(np.array)
noises = st.builds(Noise, st.floats(0.0, 2.0), st.floats(0.0, 0.2))
seeds = st.integers(0, 2**32 - 1)


def executed(planar: np.ndarray, command: np.ndarray, noise: Noise, seed: int) -> np.ndarray:
    return ROBOT.execute(planar, command, noise, np.random.default_rng(seed))


def rolled(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the wheels' travel that drives the arc between two poses, m; turns below pi."""
    turn = float(wrap_angle(after[2] - before[2]))
    c, s = math.cos(before[2] + 0.5 * turn), math.sin(before[2] + 0.5 * turn)
    chord = c * (after[0] - before[0]) + s * (after[1] - before[1])
    length = chord / np.sinc(0.5 * turn / math.pi)
    return np.array([length - 0.5 * ROBOT.track * turn, length + 0.5 * ROBOT.track * turn])


def differs(a: float, b: float) -> float:
    return abs(float(wrap_angle(a - b)))


@given(planars, commands)
def test_without_noise_it_solves_the_differential_equation(planar: np.ndarray, command: np.ndarray) -> None:
    """``x. = v cos, y. = v sin, heading. = (v_r - v_l) / track``, by an adaptive solver."""
    speed, rate = command.mean(), (command[1] - command[0]) / ROBOT.track
    slope = lambda _, z: [speed * np.cos(z[2]), speed * np.sin(z[2]), rate]
    truth = solve_ivp(slope, (0.0, 1.0), planar, rtol=1e-10, atol=1e-12).y[:, -1]
    after = executed(planar, command, NOISE_LEVELS["none"], 0)
    np.testing.assert_allclose(after[:2], truth[:2], atol=1e-8)
    assert differs(after[2], truth[2]) < 1e-8 and -math.pi <= after[2] < math.pi


def test_by_hand() -> None:
    """Equal wheels drive straight, one wheel turns about the other, opposite wheels turn in place."""
    none = NOISE_LEVELS["none"]
    np.testing.assert_allclose(executed(np.zeros(3), np.array([0.1, 0.1]), none, 0), [0.1, 0.0, 0.0])
    spun = executed(np.zeros(3), np.array([-0.08, 0.08]), none, 0)
    np.testing.assert_allclose(spun, [0.0, 0.0, 1.0], atol=1e-12)
    about_left = executed(np.zeros(3), np.array([0.0, 0.16]), none, 0)  # the left wheel stands at (0, 0.08)
    np.testing.assert_allclose(about_left, [0.08 * math.sin(1.0), 0.08 - 0.08 * math.cos(1.0), 1.0])


@given(planars, commands, noises, seeds)
def test_noise_never_reverses_a_wheel_and_never_moves_one_at_rest(planar, command, noise, seed) -> None:
    # Half the command: a turn below pi says what the wheels have rolled
    after = executed(planar, 0.5 * command, noise, seed)
    # The seed gives the wheels' normals again
    normals = np.random.default_rng(seed).standard_normal(2)
    wide = np.hypot(noise.slip * 0.5 * command, noise.play)
    expected = np.where(command != 0.0, np.sign(command) * np.maximum(0.0, np.abs(0.5 * command) + wide * normals), 0.0)
    assert (expected * command >= 0.0).all()
    if abs(expected[1] - expected[0]) < 3.0 * ROBOT.track:
        np.testing.assert_allclose(rolled(planar, after), expected, atol=1e-9)


@pytest.mark.parametrize("level", ["low", "mid", "high"])
@pytest.mark.parametrize("travel", [0.02, -0.16])
def test_wheel_errors_are_independent_with_the_stated_deviations(level: str, travel: float) -> None:
    noise, rng = NOISE_LEVELS[level], np.random.default_rng(1)
    command = np.array([travel, travel])
    wheels = np.array([rolled(START, ROBOT.execute(START, command, noise, rng)) for _ in range(20_000)])
    # Rectified, the mean and width of a Gaussian cut at zero differ from its own only where it reaches there.
    if math.hypot(noise.slip * travel, noise.play) < abs(travel) / 4.0:
        np.testing.assert_allclose(wheels.std(axis=0), math.hypot(noise.slip * travel, noise.play), rtol=0.03)
        np.testing.assert_allclose(wheels.mean(axis=0), travel, atol=3e-4)
    assert abs(np.corrcoef(wheels.T)[0, 1]) < 0.03
    assert (np.sign(travel) * wheels > -1e-12).all()


def test_levels_grow_and_turn_about_as_much_as_the_holonomic_robots() -> None:
    for level, degrees in (("low", 3.0), ("mid", 6.0), ("high", 9.0)):
        noise = NOISE_LEVELS[level]
        wheel = math.hypot(noise.slip * ROBOT.max_travel, noise.play)
        assert math.degrees(math.sqrt(2.0) * wheel / ROBOT.track) == pytest.approx(degrees, rel=0.15)
    with pytest.raises(
        InputError, match="environment: noise: expected one of none, low, mid, high, or a DifferentialExecutionNoise"
    ):
        ROBOT.parse_noise("loud")
    with pytest.raises(InputError, match="DifferentialExecutionNoise: slip"):
        Noise(slip=-1.0, play=0.0)


# --- the simulator's twin, and the model's law


@given(planars, commands, noises, seeds)
def test_the_robot_equals_the_models_law(planar, command, noise, seed) -> None:
    """The same normals give the same pose in NumPy and in JAX, rectified noise included."""
    twin, normal = executed(planar, command, noise, seed), np.random.default_rng(seed).standard_normal(2)
    with jax.enable_x64(True):
        drive = DifferentialDrive(DifferentialNoise(noise.slip, noise.play), ROBOT.track)
        law = np.asarray(drive.executed(*map(jnp.asarray, (planar, command, normal))))
    np.testing.assert_allclose(law[:2], twin[:2], atol=1e-9)
    assert differs(law[2], twin[2]) < 1e-9


@pytest.mark.parametrize(
    "noise", [Noise(slip=0.04, play=0.0005), Noise(slip=0.1, play=0.01)], ids=["small", "rectified"]
)
@pytest.mark.parametrize(
    "command", [(0.12, 0.12), (0.16, 0.10), (-0.08, 0.08), (0.0, 0.1), (-0.15, -0.14), (0.0, 0.0), (0.004, -0.008)]
)
def test_its_prediction_agrees_with_the_simulators_robot(command: tuple[float, float], noise: Noise) -> None:
    """The moments are right where noise is larger than the travel of a wheel, which it never reverses."""
    u = np.array(command)
    drive = DifferentialDrive(DifferentialNoise(noise.slip, noise.play), ROBOT.track, skid=(0.0, 0.0, 0.0))
    rng = np.random.default_rng(3)
    samples = np.array([ROBOT.execute(START, u, noise, rng) for _ in range(8000)])
    known = GaussianBelief(jnp.asarray(START, jnp.float32), jnp.zeros((3, 3)), PLANAR)
    predicted = drive.predict(known, jnp.asarray(u, jnp.float32), ROBOT.dt)
    xi = np.asarray(PLANAR.error(predicted.mean, jnp.asarray(samples, jnp.float32)), float)
    spread = np.sqrt(np.maximum(np.diag(np.asarray(predicted.covariance, float)), 1e-8))
    found = np.cov(xi.T) / np.outer(spread, spread)
    np.testing.assert_allclose(found, np.asarray(predicted.covariance) / np.outer(spread, spread), atol=0.1)
    np.testing.assert_allclose(xi.mean(axis=0) / spread, 0.0, atol=0.1)


@pytest.mark.parametrize("command", [(0.12, 0.10), (-0.05, 0.08), (0.0, 0.1), (0.1, 0.1)])
def test_samples_follow_the_density(command: tuple[float, float]) -> None:
    """``E[log p]`` over samples is minus the entropy of the Gaussian, and the mean is the likeliest pose nearby."""
    drive = DifferentialDrive(DifferentialNoise(0.05, 0.001), ROBOT.track)
    states, u = jnp.tile(jnp.asarray(START, jnp.float32), (20_000, 1)), jnp.asarray(command, jnp.float32)
    controls = jnp.tile(u, (20_000, 1))
    log_prob = jax.jit(lambda after, before, u: drive.log_prob(after, before, u, ROBOT.dt))
    samples = jax.jit(lambda before, u: drive.sample(jax.random.PRNGKey(0), before, u, ROBOT.dt))(states, controls)
    log_p = np.asarray(log_prob(samples, states, controls), float)
    Q = np.asarray(jax.jit(lambda before, u: drive.noise_covariance(before, u, ROBOT.dt))(states[0], u), float)
    entropy = 0.5 * np.log(np.linalg.det(2.0 * np.pi * np.e * Q))
    assert log_p.mean() == pytest.approx(-entropy, abs=0.05)
    assert log_p.std() == pytest.approx(math.sqrt(1.5), rel=0.05)  # of half a chi-square of three degrees
    mean = drive.mean(states[0], u, ROBOT.dt)
    assert log_prob(mean, states[0], u) >= log_p.max() - 1e-3


@pytest.mark.parametrize("control", [(0.0, 0.0), (0.1, 0.0), (0.1, 0.1), (-0.1, 0.12)])
def test_the_transition_is_smooth_at_rest_too(control: tuple[float, float]) -> None:
    """Derivatives are finite, and those of the mean are finite differences."""
    with jax.enable_x64(True):
        drive, u = DifferentialDrive(DifferentialNoise(0.05, 0.001), ROBOT.track), jnp.array(control)
        state = jnp.asarray(START)
        mean = jax.jit(lambda u: drive.mean(state, u, ROBOT.dt))
        J = np.asarray(jax.jit(jax.jacfwd(mean))(u))
        h = 1e-6
        pairs = [(mean(u + d), mean(u - d)) for d in h * np.eye(2)]
        numeric = np.stack([(np.asarray(up) - np.asarray(down)) / (2.0 * h) for up, down in pairs], axis=1)
        np.testing.assert_allclose(J, numeric, atol=1e-7)
        gradient = jax.jit(jax.grad(lambda u: drive.log_prob(mean(u), state, u, ROBOT.dt)))(u)
        assert np.isfinite(np.asarray(gradient)).all()


# --- the robot in an apartment


def make(**keywords) -> gym.Env:
    given = {"scene": two_rooms(), "camera": {"width": 32, "height": 24}, "robot": "differential"}
    return gym.make("vssm_gym/PointNav-v0", **given | keywords)


def test_it_starts_as_the_holonomic_robot_does() -> None:
    """Cylinder, camera and step are the same, and so are tasks and the first image."""
    round_one = HolonomicRobot()
    for measure in ("body_length", "height", "camera_height", "dt", "radius"):
        assert getattr(ROBOT, measure) == getattr(round_one, measure)
    np.testing.assert_array_equal(ROBOT.T_body_cam, round_one.T_body_cam)
    (ours, info), (theirs, other) = make().reset(seed=4), make(robot="holonomic").reset(seed=4)
    assert info["task"] == other["task"]
    for key in ours:
        np.testing.assert_array_equal(ours[key], theirs[key])


@pytest.mark.parametrize("name", ["PointNav", "ImageNav", "Explore"])
def test_it_follows_its_law_and_slides_along_walls(name: str) -> None:
    env = gym.make(
        f"vssm_gym/{name}-v0",
        scene=two_rooms(),
        camera={"width": 32, "height": 24},
        robot="differential",
        noise="mid",
    )
    assert env.action_space.shape == (3,)
    env.reset(seed=2)
    simulation, stream = env.unwrapped.simulation, np.random.default_rng(np.random.SeedSequence(2).spawn(4)[2])
    assert simulation.noise == NOISE_LEVELS["mid"]
    met = free = 0
    for step in range(60):
        before = simulation.planar
        action = np.array([0.15, 0.13 if step < 20 else 0.15, 0.0], np.float32)
        observation, _, terminated, _, info = env.step(action)
        assert env.observation_space.contains(observation) and not terminated
        wanted = ROBOT.execute(before, info["control"], simulation.noise, stream)
        met, free = met + info["collision"], free + (not info["collision"])
        if not info["collision"]:
            np.testing.assert_allclose(simulation.planar, wanted, atol=1e-9)
    assert met > 3 and free > 3


def test_commands_are_clipped_a_stop_ends_the_episode_and_seeds_repeat() -> None:
    env = make(noise="high")
    env.reset(seed=0)
    info = env.step(np.array([1.0, -1.0, 0.0], np.float32))[4]
    np.testing.assert_array_equal(info["control"], [0.16, -0.16])
    assert env.step(np.array([0.1, 0.1, 1.0], np.float32))[2]
    with pytest.raises(InputError, match=r"3 numbers \(left, right, stop\)"):
        env.reset()
        env.step(np.zeros(4, np.float32))
    said = []
    for world in (env, make(noise="high")):
        world.reset(seed=9)
        said.append([world.step(np.array([0.1, 0.12, 0.0], np.float32))[0]["rgb"].tobytes() for _ in range(5)])
    assert said[0] == said[1]


def test_gymnasium_accepts_it() -> None:
    check_env(make(sensors=["lidar"]).unwrapped, skip_render_check=True)


def test_an_unknown_robot_is_refused_and_the_known_ones_are_listed() -> None:
    with pytest.raises(InputError, match="robot: expected one of 'holonomic', 'worn', 'differential'; found 'tracked'"):
        make(robot="tracked")


@pytest.mark.slow
@pytest.mark.parametrize("name", filters_for(DifferentialDrive(DifferentialNoise(0.05, 0.004))))
def test_every_filter_takes_it(name: str) -> None:
    """Every filter tracks the arc of the filters' room, driven on two wheels."""
    drive = DifferentialDrive(DifferentialNoise(0.05, 0.004))
    outer = 0.5 * test_filters.TURN * drive.track
    travel = jnp.array([test_filters.STEP - outer, test_filters.STEP + outer])
    test_filters.follow(name, drive, lambda k: travel)
