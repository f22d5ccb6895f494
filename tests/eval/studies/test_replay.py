"""Test the replay of drives: parts share nothing, and a filter that knows the motion is calibrated on it."""

from dataclasses import replace

import numpy as np
import pytest

from vssm_gym.envs.robots import NOISE_LEVELS, HolonomicRobot
from vssm_gym.eval.protocols.agent_context import context_of
from vssm_gym.eval.studies.calibration.errors import summarise
from vssm_gym.eval.studies.calibration.replay import Drive, errors_of, measure
from vssm_gym.model.transition import MotionNoise, Planar
from vssm_gym.planning.pursuit import steer

NOISE = NOISE_LEVELS["low"]


def drive(seed: int, frames: int = 51) -> Drive:
    """Drive on an empty floor with the robot's own noise; there are no images, and no slip either."""
    robot, rng = HolonomicRobot(), np.random.default_rng(seed)
    start = np.array([1.0, 2.0, 0.5])
    context = context_of(robot, robot.body_length, start, success_radius=0.0, noise=NOISE)
    context = replace(context, transition=Planar(MotionNoise(NOISE.turn, NOISE.step), slip=(1e-4, 1e-4, 1e-4)))
    planar, commands = [start], []
    path = rng.uniform(-6.0, 6.0, (30, 2))
    for _ in range(frames - 1):
        commands.append(steer(planar[-1], np.array([planar[-1][:2], path[len(planar) // 20]]), robot.limits))
        planar.append(robot.execute(planar[-1], commands[-1], NOISE, rng))
    contacts = np.zeros(frames - 1, bool)
    contacts[3] = True
    images = tuple((np.full((1, 1, 3), i, np.uint8), np.ones((1, 1))) for i in range(frames))
    return Drive(context, images, np.array(commands), np.array(planar), contacts)


def test_segments_of_a_drive_share_no_frame_and_start_at_the_true_pose() -> None:
    whole = drive(0)
    parts = whole.segments(5.0)
    assert [len(part.planar) for part in parts] == [25, 25]  # of 51 frames at 5 Hz
    for first, part in zip((0, 25), parts, strict=True):
        np.testing.assert_array_equal(part.context.start_pose, whole.planar[first])
        np.testing.assert_array_equal(part.planar, whole.planar[first : first + 25])
        np.testing.assert_array_equal(part.commands, whole.commands[first : first + 24])
        assert [int(rgb[0, 0, 0]) for rgb, _ in part.images] == list(range(first, first + 25))
    assert [bool(part.contacts.any()) for part in parts] == [True, False]


@pytest.mark.slow
def test_integrated_commands_are_calibrated_where_the_noise_is_known() -> None:
    """The simulator's execution against the transition's covariance, over 20 s; half the noise is noticed."""
    runs = [measure(drive(seed), "dead_reckoning", lambda context: None, 5.0) for seed in range(30)]
    row = summarise(runs)
    assert (row["frames"], row["lost"], row["segments"]["count"]) == (1500, 0, 60)
    assert 0.6 < row["nees"]["mean"] < 1.6
    assert row["segments"]["share"] > 0.85
    contacts = measure(drive(0), "dead_reckoning", lambda context: None, 5.0, only_contacts=True)
    assert contacts.ends == runs[0].ends[:1]
    halved = Planar(MotionNoise(NOISE.turn / 2, NOISE.step / 2), slip=(1e-4, 1e-4, 1e-4))
    bold = []
    for seed in range(10):
        one = drive(seed)
        bold.append(errors_of(replace(one, context=replace(one.context, transition=halved)), "dead_reckoning", _no_map))
    right = np.mean([run.whole.nees.mean() for run in runs[:10]])
    assert np.mean([errors.nees.mean() for errors in bold]) == pytest.approx(4 * right, rel=0.2)


def _no_map(context: object) -> None:
    return None
