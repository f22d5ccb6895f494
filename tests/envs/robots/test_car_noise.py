"""Test the laws of the car's noise: first-order lag, rate, play, droop, and the statistics of its parameters."""

import math

import numpy as np
import pytest

from vssm_gym.envs.robots.car_noise import BATTERY, NOISE_LEVELS, TICK, CarActuators, CarNoise, car_noise
from vssm_gym.errors import InputError

DT = 0.1


def actuators(seed: int = 0, **fields) -> CarActuators:
    return CarActuators(CarNoise(**fields), np.random.default_rng(seed))


def hold(servos: CarActuators, speed: float, steering: float, seconds: float) -> np.ndarray:
    """Return the set points while a command is held, ``(n, 2)``, one a TICK."""
    steps = [servos(np.array([speed, speed]), steering, DT)[0] for _ in range(round(seconds / DT))]
    return np.concatenate(steps)


def test_without_noise_set_points_are_the_commands():
    servos = actuators()
    points, friction = servos(np.array([0.2, 0.4]), 0.3, DT)
    np.testing.assert_allclose(points[:, 0], 0.2 + 0.2 * np.arange(1, 11) / 10, rtol=1e-12)  # the ramp
    np.testing.assert_array_equal(points[:, 1], 0.3)
    assert friction == 1.0


def test_lag_is_first_order():
    points = hold(actuators(speed_lag=0.1, steering_lag=0.3), 0.5, 0.4, 1.0)
    time = TICK * np.arange(1, 101)
    np.testing.assert_allclose(points[:, 0], 0.5 * -np.expm1(-time / 0.1), rtol=1e-9)
    np.testing.assert_allclose(points[:, 1], 0.4 * -np.expm1(-time / 0.3), rtol=1e-9)


def test_the_servo_is_no_faster_than_its_rate():
    points = hold(actuators(steering_rate=2.0), 0.0, 0.5, 0.3)
    np.testing.assert_allclose(points[:, 1], np.minimum(2.0 * TICK * np.arange(1, 31), 0.5), rtol=1e-9)


def test_play_is_lost_at_every_reversal():
    """A servo that sweeps between +-A moves wheels with a play of b between +-(A - b / 2): a hysteresis."""
    servos = actuators(backlash=0.1)
    assert hold(servos, 0.0, 0.3, 0.1)[-1, 1] == pytest.approx(0.25)
    assert hold(servos, 0.0, 0.22, 0.1)[-1, 1] == pytest.approx(0.25)  # within the play nothing moves
    assert hold(servos, 0.0, 0.1, 0.1)[-1, 1] == pytest.approx(0.15)
    assert hold(servos, 0.0, -0.3, 0.1)[-1, 1] == pytest.approx(-0.25)


def test_the_battery_droops_to_its_share():
    servos = actuators(droop=0.2)
    assert hold(servos, 0.5, 0.0, DT)[0, 0] == pytest.approx(0.5, rel=1e-4)
    servos.time = BATTERY
    assert hold(servos, 0.5, 0.0, DT)[0, 0] == pytest.approx(0.5 * (1.0 - 0.2 * -math.expm1(-1.0)), rel=1e-4)
    servos.time = 1e6
    assert hold(servos, 0.5, 0.0, DT)[0, 0] == pytest.approx(0.4)


def test_drawn_parameters_have_their_standard_deviations():
    noise = {"calibration": 0.05, "trim": 0.02}
    first = np.array([hold(actuators(seed, **noise), 1.0, 0.0, DT)[0] for seed in range(3000)])
    assert first.mean(axis=0) == pytest.approx([1.0, 0.0], abs=0.005)
    assert first.std(axis=0) == pytest.approx([0.05, 0.02], rel=0.06)

    servos = actuators(speed_jitter=0.1, steering_jitter=0.03, patchiness=0.2, friction=0.5)
    drawn = [servos(np.array([0.5, 0.5]), 0.1, DT) for _ in range(3000)]
    points, friction = np.array([step[0][0] for step in drawn]), np.array([step[1] for step in drawn])
    assert points.mean(axis=0) == pytest.approx([0.5, 0.1], abs=0.005)
    assert points.std(axis=0) == pytest.approx([0.05, 0.03], rel=0.06)
    assert np.log(friction).mean() == pytest.approx(math.log(0.5), abs=0.015)
    assert np.log(friction).std() == pytest.approx(0.2, rel=0.06)
    assert abs(np.corrcoef(points.T)[0, 1]) < 0.06


def test_a_car_that_stands_does_not_creep():
    assert (hold(actuators(3, **vars(NOISE_LEVELS["high"])), 0.0, 0.2, 1.0)[:, 0] == 0.0).all()


def test_every_step_draws_the_same_number_of_normals():
    one, other = (np.random.default_rng(7) for _ in range(2))
    for rng, speed in ((one, 0.0), (other, 0.5)):
        servos = CarActuators(NOISE_LEVELS["mid" if speed else "none"], rng)
        for _ in range(5):
            servos(np.array([speed, speed]), speed, DT)
    assert one.random() == other.random()


def test_levels_grow_and_the_level_none_is_exact():
    assert NOISE_LEVELS["none"] == CarNoise()
    names = [name for name in vars(CarNoise()) if name not in ("friction", "steering_rate")]
    for weaker, stronger in (("none", "low"), ("low", "mid"), ("mid", "high")):
        a, b = NOISE_LEVELS[weaker], NOISE_LEVELS[stronger]
        assert all(getattr(a, name) < getattr(b, name) for name in names)
        assert a.friction > b.friction and a.steering_rate > b.steering_rate
    assert car_noise("mid") is NOISE_LEVELS["mid"] and car_noise(CarNoise(droop=0.1)).droop == 0.1


@pytest.mark.parametrize(
    ("fields", "name"),
    [
        ({"droop": 1.0}, "droop"),
        ({"droop": -0.1}, "droop"),
        ({"friction": 0.0}, "friction"),
        ({"friction": math.inf}, "friction"),
        ({"steering_rate": 0.0}, "steering_rate"),
        ({"speed_lag": math.nan}, "speed_lag"),
        ({"backlash": "much"}, "backlash"),
        ({"trim": True}, "trim"),
    ],
)
def test_impossible_noise_is_refused(fields, name):
    with pytest.raises(InputError, match=f"CarNoise: {name}"):
        CarNoise(**fields)


@pytest.mark.parametrize("level", ["loud", 3, None])
def test_unknown_levels_are_refused(level):
    with pytest.raises(InputError, match="environment: noise: expected one of none, low, mid, high"):
        car_noise(level)
