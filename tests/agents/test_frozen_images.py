"""Test the evidence for a frozen camera: commands say that the robot moved, and the image repeats."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from vssm_gym.agents.shared.frozen_images import FrozenConfig, FrozenImages, Liveness
from vssm_gym.model.transition import Bicycle, MotionNoise, Planar
from vssm_gym.model.transition.base import Transition

LOW = Planar(MotionNoise(math.radians(3.0), 0.02))
HIGH = Planar(MotionNoise(math.radians(9.0), 0.06))
STAND, DRIVE, TURN = np.zeros(3), np.array([0.0, 0.0, 0.16]), np.array([0.2, 0.0, 0.0])
LIVE, SUSPECT, FROZEN = Liveness


def image(seed: int = 0) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {"rgb": rng.integers(0, 256, (6, 8, 3), np.uint8), "depth": rng.uniform(1.0, 2.0, (6, 8)).astype(np.float32)}


def watch(transition: Transition = LOW, dt: float = 0.2) -> FrozenImages:
    images = FrozenImages(transition, dt, FrozenConfig())
    images.reset(image())
    return images


def test_a_standing_robot_repeats_its_images():
    images = watch()
    assert {images.update(STAND, image()) for _ in range(100)} == {LIVE}


def test_one_new_pixel_is_a_live_camera():
    images = watch()
    for k in range(20):
        changed = image()
        changed["rgb"][0, 0, 0] = k
        assert images.update(DRIVE, changed) is LIVE


def test_a_robot_that_should_drive_may_be_held():
    """An obstacle stops it for ever; only a command to turn shows that the camera is frozen."""
    images = watch()
    assert [images.update(DRIVE, image()) for _ in range(5)] == [LIVE] * 3 + [SUSPECT] * 2
    assert [images.update(TURN, image()) for _ in range(2)] == [SUSPECT, FROZEN]
    assert images.update(STAND, image()) is FROZEN
    assert images.update(STAND, image(1)) is LIVE
    assert images.update(STAND, image(1)) is LIVE


def test_pixels_without_a_reading_repeat_too():
    """Depth is NaN there, and NaN is not equal to itself."""
    images, blind = watch(), image()
    blind["depth"][0, 0] = np.nan
    images.reset(blind)
    assert [images.update(TURN, {name: np.array(value) for name, value in blind.items()}) for _ in range(4)][
        -1
    ] is FROZEN


def test_what_noise_may_have_cancelled_is_no_evidence():
    """At high noise a quarter of these turns is not carried out: it takes more of them than at low noise."""
    steps, turn = [], 0.5 * TURN
    for transition in (LOW, HIGH):
        images, count = watch(transition), 1
        while images.update(turn, image()) is not FROZEN:
            count += 1
        steps.append(count)
    assert FrozenConfig().images <= steps[0] < steps[1]
    not_carried_out = norm.cdf(-turn[0] / HIGH.noise.turn)
    assert 0.25 < not_carried_out < 0.3
    assert not_carried_out ** steps[1] < FrozenConfig().frozen


def test_chance_alone_stops_no_robot_for_good():
    """At high noise four full turns in a row are not carried out now and then: only more of them make it sure."""
    images = watch(HIGH)
    assert [images.update(TURN, image()) for _ in range(5)][-2:] == [SUSPECT, SUSPECT]
    assert images.update(TURN, image(1)) is LIVE


def test_steps_too_short_for_certainty_add_up():
    images = watch()
    creeping = np.array([0.0, 0.0, 0.01])  # half a standard deviation
    outcomes = [images.update(creeping, image()) for _ in range(40)]
    assert outcomes[:4] == [LIVE] * 4
    assert SUSPECT in outcomes
    assert FROZEN not in outcomes


@pytest.mark.parametrize(("command", "expected"), [((0.0, 0.3), LIVE), ((0.5, 0.0), SUSPECT), ((0.5, 0.4), FROZEN)])
def test_a_car(command, expected):
    """Wheels that are turned by a standing car move nothing."""
    images = watch(Bicycle(), 0.1)
    assert [images.update(np.array(command), image()) for _ in range(4)][-1] is expected
