"""Test thinning of frames to a rate, and reading images ahead."""

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.errors import InputError
from vssm_gym.slam import run as slam_run
from vssm_gym.slam.run import prefetch, thin


@given(
    gaps=st.lists(st.floats(0.001, 0.5), min_size=1, max_size=60),
    rate=st.floats(0.5, 40.0),
)
def test_thinning_holds_its_rate_over_every_stretch(gaps, rate):
    times = 1.3e9 + np.cumsum(gaps)
    kept = thin(times, rate)
    assert kept[0] == 0
    assert kept == sorted(set(kept))
    stamps = times[kept]
    for i in range(len(stamps)):
        counts = np.arange(1, len(stamps) - i + 1)
        assert (counts <= (stamps[i:] - stamps[i]) * rate + 1.5 + 1e-4).all()
    # And it leaves out no more than it must: where frames are missing, the period holds a frame.
    longest = max([*gaps, 0.0])
    assert (np.diff(stamps) <= 1.5 / rate + longest + 1e-6).all()


@given(st.lists(st.floats(-0.024, 0.024), min_size=2, max_size=80))
def test_a_jittering_camera_at_the_rate_keeps_every_frame(jitter):
    times = 1.3e9 + 0.1 * np.arange(len(jitter)) + np.array(jitter)
    assert thin(times, 10.0) == list(range(len(jitter)))


def test_a_third_of_a_fast_camera_is_a_third():
    times = np.arange(300) / 30.0
    kept = thin(times, 10.0)
    assert len(kept) == pytest.approx(100, abs=1)
    assert set(np.diff(kept)[2:]) == {3}


class SlowReader:
    """Return each frame's number, late ones first; fail at ``broken``."""

    def __init__(self, broken: int | None = None) -> None:
        self.broken, self.asked = broken, []

    def __getitem__(self, index):
        self.asked.append(index)
        if index == self.broken:
            raise InputError("image.png", "pixels", "a readable image")
        time.sleep(0.002 * (index % 3))
        return np.full((1, 1, 3), index), np.full((1, 1), index)


def test_images_arrive_in_order_and_a_bad_one_raises_in_its_turn():
    images = prefetch(SlowReader(), [3, 1, 4, 1, 5, 9, 2, 6])
    assert [int(depth[0, 0]) for _, depth, _ in images] == [3, 1, 4, 1, 5, 9, 2, 6]
    images = prefetch(SlowReader(broken=5), [3, 1, 4, 1, 5, 9])
    assert [next(images)[1][0, 0] for _ in range(4)] == [3, 1, 4, 1]
    with pytest.raises(InputError):
        next(images)


def test_reading_stops_when_the_consumer_does():
    reader = SlowReader()
    images = prefetch(reader, list(range(100)))
    next(images)
    images.close()
    read = len(reader.asked)
    assert read <= slam_run.READ_AHEAD + 1
    time.sleep(0.05)
    assert len(reader.asked) == read
