"""Test pictures as text and the names of keys, without a terminal."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from rich.table import Table

from tests.helpers.ansi import pixels
from vssm_gym.cli.shared.console import literal_console, say
from vssm_gym.cli.shared.terminal import split_keys
from vssm_gym.viz.terminal import NO_READING, depth_picture, half_blocks, side_by_side

images = arrays(np.uint8, st.tuples(st.integers(1, 7), st.integers(1, 6), st.just(3)), elements=st.integers(0, 255))


@given(images)
def test_every_pixel_is_shown_in_its_colour(image):
    shown = pixels(half_blocks(image))
    np.testing.assert_array_equal(shown[: len(image)], image)
    assert len(shown) == len(image) + len(image) % 2
    assert not shown[len(image) :].any()


@given(images)
def test_256_colours_are_the_nearest_of_the_cube(image):
    shown = pixels(half_blocks(image, "256"))[: len(image)].astype(int)
    levels = np.array([0, 95, 135, 175, 215, 255])
    best = np.abs(image[..., None].astype(int) - levels).min(axis=-1)
    np.testing.assert_array_equal(np.abs(shown - image), best)


def test_a_colour_is_written_where_it_changes():
    """A line of one colour is one escape sequence, so that pictures fit through a slow connection."""
    (line,) = half_blocks(np.full((2, 50, 3), 7, np.uint8))
    assert line == "\x1b[38;2;7;7;7;48;2;7;7;7m" + "▀" * 50 + "\x1b[0m"


def test_depth_by_hand():
    """Near is white, 3 of 6 m middle grey, far black; a pixel without a reading has a colour."""
    shown = depth_picture(np.array([[1e-6, 3.0, 6.0, 50.0, 0.0]], np.float32))[0]
    assert shown.tolist() == [[255] * 3, [128] * 3, [0] * 3, [0] * 3, list(NO_READING)]


@given(
    st.lists(st.tuples(st.integers(8, 60), st.integers(8, 80)), min_size=1, max_size=3),
    st.integers(12, 200),
    st.integers(2, 60),
)
def test_pictures_side_by_side_fit_and_keep_their_shape(sizes, columns, rows):
    lines = side_by_side([np.full((*size, 3), 200, np.uint8) for size in sizes], columns, rows)
    widths = {len(re.sub(r"\x1b\[[\d;]*m", "", line)) for line in lines}
    assert len(widths) == 1
    assert len(lines) <= rows
    if columns >= 30 * len(sizes):  # a terminal narrower than any picture gets one row all the same
        assert widths.pop() <= columns
        for (height, width), panel in zip(sizes, lines[0].split(" "), strict=True):
            shown = len(re.sub(r"\x1b\[[\d;]*m", "", panel))
            assert abs(shown - 2 * len(lines) * width / height) <= 1.0


@pytest.mark.parametrize(
    ("typed", "keys"),
    [
        ("wW ", ["w", "w", "space"]),
        ("\x1b[A\x1b[B\x1bOC\x1b[D", ["up", "down", "right", "left"]),
        ("\x1b[1;5Aq", ["up", "q"]),  # with Ctrl held
        ("\x1b[3~\x1b[15~r", ["r"]),  # Delete and F5 mean nothing
        ("\x1b", ["escape"]),
        ("\x1b[", []),
        ("ä\n", ["ä", "\n"]),
        ("", []),
    ],
)
def test_keys_have_names(typed, keys):
    assert split_keys(typed) == keys


def test_a_line_that_is_said_is_one_line_of_visible_characters(capsys):
    """A name can neither move the cursor, nor begin a line that looks like another message, nor set a title."""
    say("oak\nerror: none\x1b[2J", "[bold]x[/] :smile:", 7)
    say("warning: \x1b]0;title\x07", error=True)
    said, warned = capsys.readouterr()
    assert said == "oak\\nerror: none\\x1b[2J\n[bold]x[/] :smile:\n7\n"
    assert warned == "warning: \\x1b]0;title\\x07\n"


def test_a_table_shows_names_as_they_are(capsys):
    table = Table("[red]agent", title="[/] :smile:\x1b[2J")
    table.add_row("[bold]x[/bold] \x9b2J\u202e")
    literal_console(width=60).print(table)
    said = capsys.readouterr().out
    for text in ("[red]agent", r"[/] :smile:\x1b[2J", r"[bold]x[/bold] \x9b2J\u202e"):
        assert text in said
