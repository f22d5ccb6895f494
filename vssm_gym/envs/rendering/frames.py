"""Turn the panels of an environment into what ``render`` returns, or into a window."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vssm_gym.envs.rendering.captions import Caption, Panel, captioned, side_by_side
from vssm_gym.envs.rendering.window import Window
from vssm_gym.envs.validation import choose
from vssm_gym.errors import InputError

RENDER_MODES = ("human", "rgb_array")


class Frames:
    """Render in one mode: None, ``rgb_array`` or ``human``.

    Args:
        source: name of the environment, which opens error messages.
        mode: the keyword ``render_mode``.
        captions: if True, arrays have a strip of text below the picture; a window always has it.
    """

    def __init__(self, source: str, mode: Any, captions: Any) -> None:
        choose(source, "render_mode", mode, (None, *RENDER_MODES))
        if not isinstance(captions, bool):
            raise InputError(source, "captions", f"True or False; found {captions!r:.80}")
        self.mode: str | None = mode
        self._captions = captions
        self._window = Window()

    def picture(self, panels: Sequence[Panel], captions: Sequence[Caption]) -> np.ndarray:
        """Return a picture, uint8 ``(height, width, 3)``."""
        return captioned(panels, captions) if self._captions or self.mode == "human" else side_by_side(panels)

    def render(self, panels: Sequence[Panel], captions: Sequence[Caption], title: str, fps: float) -> np.ndarray | None:
        """Return :meth:`picture`; in mode ``human`` show it for ``1 / fps`` s and return None.

        Raises ``SystemExit`` where the user has closed the window, which ends a program without an error.
        """
        picture = self.picture(panels, captions)
        if self.mode != "human":
            return picture
        if not self._window.show(picture, title, fps):
            self._window.close()
            raise SystemExit(0)
        return None

    def close(self) -> None:
        """Close the window."""
        self._window.close()
