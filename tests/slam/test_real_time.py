"""Test the real-time factor and the share of frames within the camera's period, by hand."""

from types import SimpleNamespace
from typing import Any

import pytest

from vssm_gym.slam.real_time import real_time


def frame(time: float, wait_s: float, step_s: float, warm: bool = True) -> Any:
    return SimpleNamespace(time=time, wait_s=wait_s, step_s=step_s, warm=warm)


def test_the_factor_and_the_share_by_hand():
    """Frames 2 to 4 are warm: 3 periods of 0.1 s in 0.02 + 0.04 + 0.14 s; one of the three is late."""
    found = real_time(
        [
            frame(5.0, 9.0, 9.0, warm=False),
            frame(5.1, 0.0, 0.7, warm=False),
            frame(5.2, 0.0, 0.02),
            frame(5.3, 0.01, 0.03),
            frame(5.4, 0.0, 0.14),
        ]
    )
    assert found is not None
    assert found["period_s"] == pytest.approx(0.1)
    assert found["factor"] == pytest.approx(0.3 / 0.2)
    assert found["within_period"] == pytest.approx(2 / 3)
    assert found["frames"] == 3
    assert found["factor_with_compiling"] == pytest.approx(0.4 / 0.9)


def test_waiting_for_an_image_counts_in_the_factor_only():
    """A filter that waits for a slow disk is behind, and no frame of it was late."""
    found = real_time([frame(0.0, 0.0, 0.05), frame(0.1, 0.2, 0.05), frame(0.2, 0.2, 0.05)])
    assert found is not None
    assert found["within_period"] == 1.0
    assert found["factor"] == pytest.approx(0.3 / 0.55)


@pytest.mark.parametrize("frames", [[], [frame(0.0, 0.0, 0.1)], [frame(0.1 * i, 0.0, 1.0, warm=False) for i in (0, 1)]])
def test_nothing_is_stated_without_a_frame_that_compiled_nothing(frames):
    assert real_time(frames) is None
