"""Test the drive by drawn commands: it shows all that a robot can do, and keeps clear of what is in the way."""

import json

import numpy as np
import pytest

from vssm_gym.cli.record import record
from vssm_gym.data.sequences import load_sequence
from vssm_gym.data.wandering import MARGINS, Wanderer
from vssm_gym.envs.robots.registry import ROBOTS
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.errors import InputError

STEPS = 1500


def free_space() -> FreeSpace:
    robot = ROBOTS["holonomic"]()
    return FreeSpace.from_apartment(load_scene("reed"), robot.radius, robot.height)


def driven(seed: int = 0, start: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return commands, places, and which places are free, of a robot that does what it is told."""
    space, robot = free_space(), ROBOTS["holonomic"]()
    centre = np.asarray(space.largest.representative_point().coords[0]) if start is None else start
    wanderer, planar = Wanderer(load_scene("reed"), robot, seed), np.array([*centre, 0.3])
    commands, places = [], []
    for _ in range(STEPS):
        turn, direction, step = command = wanderer(planar)
        angle = planar[2] + direction
        planar = planar + np.array([step * np.cos(angle), step * np.sin(angle), turn])
        commands.append(command)
        places.append(planar[:2])
    return np.array(commands), np.array(places), space.contains(np.array(places))


@pytest.fixture(scope="module")
def drive():
    return driven()


def test_commands_are_of_all_kinds_within_the_limits(drive):
    commands, _, _ = drive
    limits = ROBOTS["holonomic"]().limits
    assert (np.abs(commands) <= limits + 1e-12).all() and (commands[:, 2] >= 0.0).all()
    turns, moves = np.abs(commands[:, 0]) > 0.02, commands[:, 2] > 0.02
    for kind, least in ((turns & moves, 0.3), (turns & ~moves, 0.1), (~turns & moves, 0.1)):
        assert kind.mean() > least
    assert np.ptp(commands[moves], axis=0) == pytest.approx([2 * limits[0], 2 * limits[1], limits[2]], rel=0.2)


def test_the_robot_stays_in_free_space_and_does_not_stay_in_place(drive):
    _, places, free = drive
    assert free.all()
    assert np.ptp(places, axis=0).max() > 2.0


def test_a_start_without_room_is_left():
    """Starts in niches and doorways, which no place with a margin reaches, are not where the drive ends."""
    space = free_space()
    drawn = space.sample(np.random.default_rng(0), 400)
    narrow = drawn[~space.widened(MARGINS[0]).contains(drawn)]
    assert len(narrow) > 20
    for seed, start in enumerate(narrow[:6]):
        _, places, free = driven(seed, start)
        assert free.all()
        assert np.ptp(places, axis=0).max() > 0.5


def test_the_same_seed_drives_the_same(drive):
    np.testing.assert_array_equal(driven()[0], drive[0])
    assert not np.array_equal(driven(1)[0], drive[0])


def test_a_drive_is_recorded(tmp_path):
    out = tmp_path / "drive"
    record("reed", out, motion="wander", robot="worn", noise="none", seconds=4.0, size="16x12", seed=3)
    recording = load_sequence(out)
    assert len(recording.frames) == 21
    assert np.count_nonzero(np.asarray(recording.controls)[1:].any(axis=1)) > 10
    about = json.loads((out / "recording.json").read_text())
    assert (about["motion"], about["robot"], about["seconds"]) == ("wander", "worn", 4.0)


def test_bad_options_are_named(tmp_path):
    with pytest.raises(InputError, match="seconds"):
        record("reed", tmp_path / "a", motion="wander", seconds=0.0)
    with pytest.raises(InputError, match="seconds"):
        record("reed", tmp_path / "b", motion="survey", seconds=10.0)
