"""Make text of any origin safe to show, in a terminal, a figure or a page.

Names come from files that others wrote: of agents, scenes, sequences and policies. Control characters move a terminal's
cursor, format characters reverse the direction of what follows, and a long name hides what stands beside it.
"""

LONGEST = 200  # characters of a name that is shown
_TAIL = 60  # of a shortened name: what tells two names apart is often at the end, such as a policy's hash


def visible(text: str) -> str:
    r"""Return ``text`` with its escape, such as ``\x1b`` or ``\u202e``, in place of each character that has no glyph.

    Line breaks are such characters too; half of a surrogate pair, which no file can hold, is another.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def shortened(text: str, longest: int = LONGEST) -> str:
    """Return ``text`` with its middle left out where it has more than ``longest`` characters."""
    if len(text) <= longest:
        return text
    tail = min(_TAIL, longest // 3)
    return f"{text[: longest - tail - 1]}…{text[-tail:]}"
