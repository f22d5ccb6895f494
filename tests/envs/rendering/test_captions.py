"""Test captions: where they stand, what they show, and that their strip keeps its size."""

import numpy as np
import pytest

from vssm_gym.envs.rendering.captions import LINE, STRIP, Caption, Panel, Tally, captioned, side_by_side

RED, BLUE = (200, 30, 30), (30, 30, 200)


def panel(width: int, title: str, legend: dict | None = None, height: int = 40) -> Panel:
    image = np.random.default_rng(width).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return Panel(image, title, legend or {})


def written(strip: np.ndarray) -> np.ndarray:
    """Return True where a pixel is not background."""
    return (strip != STRIP).any(axis=2)


def test_a_tally_counts_steps_rewards_and_the_last_event():
    tally = Tally().after(0.5, False, {"collision": True, "success": False})
    assert (tally.steps, tally.reward, tally.total, tally.event) == (1, 0.5, 0.5, "collision")
    tally = tally.after(-0.25, False, {"collision": False})
    assert (tally.steps, tally.reward, tally.total, tally.event) == (2, -0.25, 0.25, "")
    assert tally.after(0.0, True, {"collision": True, "success": False}).event == "failure"
    assert tally.after(0.0, True, {"collision": False, "success": True}).event == "success"
    shown = tally.captions([Caption("goal", "1.00 m")])
    assert [(caption.label, caption.value) for caption in shown] == [
        ("step", "2"),
        ("reward", "-0.250"),
        ("return", "+0.25"),
        ("goal", "1.00 m"),
        ("", ""),
    ]


def test_panels_are_not_touched_and_each_title_stands_below_its_own():
    panels = [panel(240, "one"), panel(300, "two")]
    frame = captioned(panels, [])
    np.testing.assert_array_equal(frame[:40], side_by_side(panels))
    titles = written(frame[40:])
    assert titles[:, :240].any() and titles[:, 240:].any()
    untitled = written(captioned([panel(240, ""), panel(300, "two")], [])[40:])
    assert not untitled[:, :240].any()
    np.testing.assert_array_equal(untitled[:, 240:], titles[:, 240:])


def test_a_legend_shows_each_colour():
    strip = captioned([panel(400, "plan", {"path": RED, "goal": BLUE})], [])[40:]
    for colour in (RED, BLUE):
        assert (strip == colour).all(axis=2).sum() == 8 * 8  # a square of 10 pixels within its outline


@pytest.mark.parametrize("width", [60, 118, 240, 360, 840])
def test_the_strip_keeps_its_size_and_its_places(width):
    """Only the pixels of a value change with it, and every caption lies inside the picture."""
    before = [Caption("step", "1"), Caption("reward", "-0.010"), Caption("goal", "12.34 m")]
    after = [Caption("step", "1"), Caption("reward", "+3.141"), Caption("goal", "12.34 m")]
    one, other = (captioned([panel(width, "")], captions)[40:] for captions in (before, after))
    assert one.shape == other.shape and len(one) % 2 == 0
    columns = max(1, width // 118)
    assert len(one) == LINE * (1 + -(-3 // columns))
    rows, places = np.nonzero((one != other).any(axis=2))
    assert len(rows) and set(rows // LINE) == {1 + 1 // columns}
    assert places.min() >= 118 * (1 % columns)
    for i in range(3):
        row, column = 1 + i // columns, 118 * (i % columns)
        assert written(one[LINE * row : LINE * (row + 1), column : column + 118]).any()
