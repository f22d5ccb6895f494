"""Write captions below a picture: what its panels show, then the state of the episode."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

RGB = tuple[int, int, int]

FONT_SIZE = 14  # pixels: still legible in a video at half its size
LINE = 22  # pixels, height of a line; even, as video encoders ask for
CELL = 118  # pixels, width of one caption: those of an environment never move
MARGIN = 8  # pixels left of a text, and between the names of a legend
SWATCH = 10  # pixels, side of a legend's coloured square
STRIP, LABEL, VALUE = (32, 34, 40), (150, 156, 168), (245, 245, 248)  # RGB of background, names and values
GOOD, BAD = (110, 210, 130), (245, 120, 100)  # RGB of an event


@dataclass(frozen=True)
class Panel:
    """Hold one of the images that lie side by side in a picture: uint8 ``(height, width, 3)``.

    ``legend`` maps what the image shows to its colour.
    """

    image: np.ndarray
    title: str
    legend: dict[str, RGB] = field(default_factory=dict)


@dataclass(frozen=True)
class Caption:
    """Hold one value of the episode's state, as text."""

    label: str
    value: str
    colour: RGB = VALUE


@dataclass(frozen=True)
class Tally:
    """Count the steps and rewards of an episode."""

    steps: int = 0
    reward: float = 0.0  # of the last step
    total: float = 0.0  # return: the sum of the rewards so far
    event: str = ""  # of the last step: "collision", "success" or "failure"

    def after(self, reward: float, terminated: bool, info: dict[str, Any]) -> "Tally":
        """Add one step; ``info["success"]`` counts where it ends the episode."""
        event = "collision" if info.get("collision") else ""
        if terminated:
            event = "success" if info.get("success") else "failure"
        return replace(self, steps=self.steps + 1, reward=reward, total=self.total + reward, event=event)

    def captions(self, own: Sequence[Caption]) -> list[Caption]:
        """Return what every environment shows, around the ``own`` captions of one."""
        return [
            Caption("step", str(self.steps)),
            Caption("reward", f"{self.reward:+.3f}"),
            Caption("return", f"{self.total:+.2f}"),
            *own,
            Caption(self.event, "", GOOD if self.event == "success" else BAD),
        ]


def side_by_side(panels: Sequence[Panel]) -> np.ndarray:
    """Join the panels, which have one height: uint8 ``(height, sum of widths, 3)``."""
    return np.concatenate([panel.image for panel in panels], axis=1)


def captioned(panels: Sequence[Panel], captions: Sequence[Caption]) -> np.ndarray:
    """Join the panels and add a strip of text below them.

    Its height depends on the width and on the number of captions only, so all pictures of an environment have one size.
    """
    picture = side_by_side(panels)
    width = picture.shape[1]
    columns = max(1, width // CELL)
    strip = Image.new("RGB", (width, LINE * (1 + -(-len(captions) // columns))), STRIP)
    pen, font, middle = ImageDraw.Draw(strip), ImageFont.load_default(FONT_SIZE), LINE // 2
    left = 0
    for panel in panels:
        x = _text(pen, font, left + MARGIN, middle, panel.title, VALUE)
        for name, colour in panel.legend.items():
            x += MARGIN
            y = middle - SWATCH // 2
            pen.rectangle((x, y, x + SWATCH - 1, y + SWATCH - 1), fill=colour, outline=LABEL)
            x = _text(pen, font, x + SWATCH + MARGIN // 2, middle, name, LABEL)
        left += panel.image.shape[1]
    for i, caption in enumerate(captions):
        y = LINE * (1 + i // columns) + middle
        colour = LABEL if caption.value else caption.colour
        x = _text(pen, font, CELL * (i % columns) + MARGIN, y, caption.label, colour)
        _text(pen, font, x + MARGIN // 2, y, caption.value, caption.colour)
    return np.concatenate([picture, np.asarray(strip)])


def _text(pen: ImageDraw.ImageDraw, font: Any, x: int, y: int, text: str, colour: RGB) -> int:
    """Write a line around the height ``y``; return where it ends."""
    pen.text((x, y), text, font=font, fill=colour, anchor="lm")
    return x + round(font.getlength(text))
