"""Test how runs of SLAM with faults are judged, on runs made by hand; and the runs themselves (slow)."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from vssm_gym.data.recording import record_handheld
from vssm_gym.data.sequences import FrameReader, load_sequence
from vssm_gym.errors import InputError
from vssm_gym.eval.faults.slam import (
    FAULT_SIZE,
    FAULTS,
    FLAG_DELAY,
    FRAMES_AFTER,
    FRAMES_BEFORE,
    FRAMES_DURING,
    WALK_CAMERA,
    judged,
    measure,
    places_of,
    write_faulty,
)
from vssm_gym.inference.status import Status
from vssm_gym.slam.run import SlamRun, TrackedFrame

LENGTH = FRAMES_BEFORE + FRAMES_DURING + FRAMES_AFTER
STATED_STD = 0.01  # m, rad


def run_of(off: dict[int, float], status: dict[int, Status]) -> SlamRun:
    """Return a run of a camera at rest, ``off[k]`` metres off at frame k, of status ok where none is given."""
    frames = []
    for k in range(LENGTH):
        T = np.eye(4)
        T[0, 3] = off.get(k, 0.0)
        frames.append(
            TrackedFrame(
                index=k,
                time=0.1 * k,
                T_world_cam=T,
                status=status.get(k, Status.OK),
                inlier_share=None,
                coverage=None,
                photometric=None,
                in_grid=1.0,
                read_s=0.0,
                wait_s=0.0,
                step_s=0.0,
                stages={},
                warm=True,
                velocity=None,
                covariance=STATED_STD**2 * np.eye(12),
                left_window=0,
            )
        )
    return SlamRun(tuple(frames), None, None, (), None)


def judge(fault: str, off: dict[int, float], status: dict[int, Status]):
    return judged(fault, "here", run_of(off, status), np.tile(np.eye(4), (LENGTH, 1, 1)))


LOST = dict.fromkeys(range(FRAMES_BEFORE, FRAMES_BEFORE + FRAMES_DURING), Status.LOST)


def test_a_fault_that_is_flagged_at_once_passes():
    row = judge("blackout", dict.fromkeys(LOST, 1.0), LOST)
    assert row.passed
    assert (row.flagged, row.back, row.wrong, row.confident) == (0, 0, 0, FRAMES_AFTER)
    assert row.error_m == 0.0


@pytest.mark.parametrize(("late", "passes"), [(FLAG_DELAY - 1, True), (FLAG_DELAY, False)])
def test_a_fault_of_the_image_must_be_flagged_in_time(late, passes):
    row = judge("frozen", {}, {FRAMES_BEFORE + late: Status.LOST})
    assert row.flagged == late
    assert row.passed == passes
    assert judge("shove", {}, {FRAMES_BEFORE + late: Status.LOST}).passed


@pytest.mark.parametrize(("metres", "passes"), [(3 * STATED_STD + 0.049, True), (3 * STATED_STD + 0.051, False)])
def test_a_confident_pose_may_be_off_by_three_stds_and_the_tolerance(metres, passes):
    row = judge("grey card", {FRAMES_BEFORE + FRAMES_DURING: metres}, LOST)
    assert row.passed == passes
    assert row.error_m == pytest.approx(metres)
    assert row.error_stds == pytest.approx(metres / STATED_STD)


def test_a_motion_that_is_tracked_need_not_be_flagged():
    assert judge("kidnap", {}, {}).passed
    row = judge("kidnap", {FRAMES_BEFORE + 1: 0.5}, {})
    assert row.missed
    assert not row.passed


def test_the_error_before_the_fault_does_not_count():
    assert judge("mirrored", dict.fromkeys(range(LENGTH), 0.4), LOST).error_m == pytest.approx(0.0, abs=1e-9)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk") / "oak"
    record_handheld("oak", folder, metres=8.0, camera=replace(WALK_CAMERA, width=80, height=60), seed=3)
    return load_sequence(folder)


def test_places_are_in_the_second_half_and_a_short_recording_has_none():
    long, short = (SimpleNamespace(root=Path("walk"), frames=range(n)) for n in (4 * LENGTH + 7, 2 * LENGTH - 2))
    assert [place.first for place in places_of(long)] == [2 * LENGTH + 3, 3 * LENGTH + 3]
    with pytest.raises(InputError, match="frames"):
        places_of(short)


@pytest.mark.slow
def test_a_faulty_recording_is_the_true_one_outside_the_fault(walk, tmp_path):
    place = places_of(walk)[0]
    T_true = write_faulty("scaled depth", place, tmp_path / "faulty", 0)
    written, true = FrameReader(load_sequence(tmp_path / "faulty")), FrameReader(walk, FAULT_SIZE)
    np.testing.assert_allclose(T_true, walk.true_poses()[place.first : place.first + LENGTH])
    for k in (0, FRAMES_BEFORE - 1, FRAMES_BEFORE, FRAMES_BEFORE + FRAMES_DURING - 1, FRAMES_BEFORE + FRAMES_DURING):
        scale = 1.2 if FRAMES_BEFORE <= k < FRAMES_BEFORE + FRAMES_DURING else 1.0
        np.testing.assert_array_equal(written[k][0], true[place.first + k][0])
        np.testing.assert_allclose(written[k][1], scale * true[place.first + k][1], atol=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_simulated_walk_with_a_fault(walk, fault):
    row = measure(fault, places_of(walk)[0])
    assert row.passed, row


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["grey card", "scaled depth"])
def test_the_real_sequence_with_a_fault(shared_data, fault):
    """A card was once relocalised 2.7 m away, and scaled depth moved the camera by 16 cm."""
    row = measure(fault, places_of(load_sequence(shared_data / "tum_fr1_xyz"))[0])
    assert row.passed, row
