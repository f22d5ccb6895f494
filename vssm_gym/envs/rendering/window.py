"""Show pictures in a window of pygame, the extra ``human``, which is imported when the window opens."""

import os
import time
from importlib import import_module
from typing import Any

import numpy as np

from vssm_gym.errors import InputError

BACKGROUND = (32, 34, 40)  # RGB around the picture in a window of another shape
UNSEEN = ("offscreen", "dummy")  # drivers that SDL takes where it finds no screen


class Window:
    """Show pictures, one every ``1 / fps`` s; it opens with the first one.

    A process has one window: pygame draws into no more.
    """

    def __init__(self) -> None:
        self._open = False
        self._due = 0.0  # s on the monotonic clock, when the next picture may be shown

    def show(self, picture: np.ndarray, title: str, fps: float) -> bool:
        """Show ``picture``, uint8 ``(height, width, 3)``, after a pause that keeps the frame rate.

        Returns False where the user has pressed Escape or the window's close button. Raises :class:`InputError` without
        pygame, without a display, and where another environment shows its window.
        """
        pygame = _pygame(title)
        if not self._open:
            _open(pygame, picture, title)
            self._open = True
        time.sleep(max(0.0, self._due - time.monotonic()))
        self._due = time.monotonic() + 1.0 / fps
        for event in pygame.event.get():
            if event.type == pygame.QUIT or (event.type == pygame.KEYDOWN and event.key == pygame.K_ESCAPE):
                return False
        _draw(pygame, picture)
        return True

    def close(self) -> None:
        """Close the window; a window that is not open stays as it is."""
        if self._open:
            import_module("pygame").display.quit()
            self._open = False


def _pygame(title: str) -> Any:
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # it would greet on standard output
    try:
        return import_module("pygame")
    except ImportError:
        expected = (
            "the extra `human` to be installed (pip install -c constraints.txt '.[human]'), or render_mode='rgb_array'"
        )
        raise InputError(title, "render_mode", expected) from None


def _open(pygame: Any, picture: np.ndarray, title: str) -> None:
    if pygame.display.get_init() and pygame.display.get_surface() is not None:
        expected = "at most one window in a process: close the environment that shows the other one"
        raise InputError(title, "render_mode", expected)
    try:
        pygame.display.init()
        driver = pygame.display.get_driver()
        if driver in UNSEEN and os.environ.get("SDL_VIDEODRIVER") != driver:
            raise pygame.error("no screen was found")
        pygame.display.set_mode(picture.shape[1::-1], pygame.RESIZABLE)
    except pygame.error as error:
        pygame.display.quit()
        expected = f"a display for 'human', in DISPLAY or WAYLAND_DISPLAY ({error}); 'rgb_array' needs none"
        raise InputError(title, "render_mode", expected) from None
    pygame.display.set_caption(title)


def _draw(pygame: Any, picture: np.ndarray) -> None:
    """Fit the picture into the window, whose size is the user's."""
    screen = pygame.display.get_surface()
    height, width = picture.shape[:2]
    image = pygame.image.frombuffer(np.ascontiguousarray(picture).tobytes(), (width, height), "RGB")
    scale = min(screen.get_width() / width, screen.get_height() / height)
    if scale != 1.0:
        image = pygame.transform.smoothscale(image, (max(1, round(width * scale)), max(1, round(height * scale))))
    screen.fill(BACKGROUND)
    screen.blit(image, image.get_rect(center=screen.get_rect().center))
    pygame.display.flip()
