"""Text of any origin is visible, on one line, and of limited length."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vssm_gym.viz.text import LONGEST, shortened, visible


@given(st.text(alphabet=st.characters(codec=None)))
def test_what_is_visible_can_be_printed_anywhere(text):
    """It holds no character without a glyph, half surrogates included, and the rest is as it was."""
    shown = visible(text)
    assert shown.isprintable()
    shown.encode()
    assert visible(shown) == shown
    if text.isprintable():
        assert shown == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("oak · µ é 😀", "oak · µ é 😀"),
        ("a\x1b[31mb", r"a\x1b[31mb"),
        ("one\ntwo\r\t", r"one\ntwo\r\t"),
        ("\u202efdp.exe\u2066", r"\u202efdp.exe\u2066"),
        ("a\u200bb\ufeff", r"a\u200bb\ufeff"),
        ("\x9b2J\x7f", r"\x9b2J\x7f"),
        ("\ud800", r"\ud800"),
    ],
)
def test_what_has_no_glyph_is_escaped(text, shown):
    assert visible(text) == shown


@given(st.text(max_size=40), st.integers(3, 30))
def test_a_shortened_text_keeps_both_ends(text, longest):
    shown = shortened(text, longest)
    assert len(shown) <= longest
    if len(text) <= longest:
        assert shown == text
    else:
        head, _, tail = shown.partition("…") if "…" not in text else (shown[:1], "", shown[-1:])
        assert text.startswith(head)
        assert text.endswith(tail)


def test_a_label_keeps_the_hash_at_its_end():
    assert shortened("n" * 5000 + "@0123abcd").endswith("n@0123abcd")
    assert len(shortened("n" * 5000)) == LONGEST
