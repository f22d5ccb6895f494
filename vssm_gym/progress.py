"""Define the type of the callbacks that report the progress of long work."""

from collections.abc import Callable

OnProgress = Callable[[str, int, int], None]  # called with the stage, the number of finished items and their total
