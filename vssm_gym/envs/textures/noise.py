"""Provide seamless building blocks of the procedural textures.

Band-limited noise, cells with joints, colour helpers.
"""

import numpy as np

TEXTURE_SIZE = 128  # pixels, edge of a texture
"""Pixels along each side of a texture."""


def grid() -> tuple[np.ndarray, np.ndarray]:
    """Return (v, u) of the pixel centres, each (TEXTURE_SIZE, TEXTURE_SIZE) in (0, 1); v runs down, u to the right."""
    at = (np.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE
    v, u = np.meshgrid(at, at, indexing="ij")
    return v, u


def noise(
    rng: np.random.Generator,
    slope: float = 1.0,
    low: float = 1.0,
    high: float = 40.0,
    stretch: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Draw periodic Gaussian noise ``(TEXTURE_SIZE, TEXTURE_SIZE)``, mean 0, std 1.

    The amplitude is f^-slope for f in [low, high] cycles a tile.

    ``stretch`` multiplies the frequencies along (v, u): (1, 8) draws features eight times longer along u.
    """
    cycles = np.fft.fftfreq(TEXTURE_SIZE, 1 / TEXTURE_SIZE)
    f = np.hypot(cycles[:, None] * stretch[0], cycles[None, :] * stretch[1])
    amplitude = np.where((f >= low) & (f <= high), np.maximum(f, 1e-9) ** -slope, 0.0)
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((TEXTURE_SIZE, TEXTURE_SIZE))) * amplitude).real
    return (field - field.mean()) / field.std()


def cells(rows: int, columns: int, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lay courses of bricks: return the cell index at each pixel, and the distance to the nearest joint in tiles.

    Row r is shifted by ``shift[r]`` cells to the left.
    """
    v, u = grid()
    row = np.floor(v * rows).astype(int)
    x = u * columns + np.asarray(shift)[row]
    column = np.floor(x).astype(int) % columns
    down, right = v * rows % 1, x % 1
    edge = np.minimum(np.minimum(down, 1 - down) / rows, np.minimum(right, 1 - right) / columns)
    return row * columns + column, edge


def lerp(a: np.ndarray | float, b: np.ndarray | float, t: np.ndarray) -> np.ndarray:
    """Return (1 - t) a + t b."""
    return a + (b - a) * t


def smooth_step(x: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return 0 below low, 1 above high, and a cubic between."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def rgb(value: np.ndarray, warmth: np.ndarray | float = 0.0) -> np.ndarray:
    """Return grey ``value`` as RGB in [0, 1]; ``warmth`` adds to red and subtracts from blue."""
    return np.clip(np.stack([value + warmth, value, value - warmth], axis=-1), 0.0, 1.0)
