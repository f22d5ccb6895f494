"""Draw textures with their own colours and an up direction.

Paintings, books, a window's view, leaves, a screen, an oven.

Unlike surfaces they do not repeat seamlessly; use them with ``Material.scale`` = the size of the box's face.
"""

from collections.abc import Callable

import numpy as np

from vssm_gym.envs.textures.noise import TEXTURE_SIZE, grid, lerp, noise, smooth_step


def _framed(image: np.ndarray, frame: tuple[float, float, float]) -> np.ndarray:
    """Put the image inside a wooden frame and a pale mount."""
    v, u = grid()
    border = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))[..., None]
    image = np.where(border < 0.09, [0.93, 0.91, 0.86], image)
    return np.clip(np.where(border < 0.05, frame, image), 0, 1)


def _mountains(rng: np.random.Generator) -> np.ndarray:
    v, u = grid()
    image = lerp(np.array([0.25, 0.45, 0.75]), np.array([0.98, 0.80, 0.60]), v[..., None] * 1.5)
    image = np.where((np.hypot(u - 0.68, v - 0.30) < 0.09)[..., None], [1.0, 0.92, 0.55], image)
    for layer in range(4):
        waves = rng.uniform(0.3, 1.0, 5) / np.arange(1, 6)
        ridge = sum(w * np.sin(2 * np.pi * (k + 1) * u + rng.uniform(0, 6)) for k, w in enumerate(waves))
        height = 0.42 + 0.15 * layer + 0.07 * ridge
        shade = np.array([0.45, 0.50, 0.62]) * (1 - 0.26 * layer) + np.array([0.0, 0.05, 0.0]) * layer
        image = np.where((v > height)[..., None], shade, image)
    return _framed(image, (0.30, 0.18, 0.08))


def _blocks(rng: np.random.Generator) -> np.ndarray:
    """Draw black bars around rectangles of primary colours."""
    v, u = grid()
    cuts_u, cuts_v = np.sort(rng.uniform(0.12, 0.9, (2, 4)), axis=1)
    column, row = np.searchsorted(cuts_u, u), np.searchsorted(cuts_v, v)
    palette = np.array(
        [[0.95, 0.94, 0.90], [0.80, 0.12, 0.10], [0.10, 0.22, 0.60], [0.95, 0.80, 0.15], [0.95, 0.94, 0.90]]
    )
    image = palette[rng.integers(0, 5, (5, 5))[row, column]]
    bar = np.minimum(np.abs(u[..., None] - cuts_u).min(-1), np.abs(v[..., None] - cuts_v).min(-1)) < 0.014
    return _framed(np.where(bar[..., None], 0.05, image), (0.08, 0.08, 0.08))


def _circles(rng: np.random.Generator) -> np.ndarray:
    """Draw a dozen concentric circles of random colours on a dark ground."""
    v, u = grid()
    image = np.broadcast_to([0.14, 0.17, 0.28], (TEXTURE_SIZE, TEXTURE_SIZE, 3))
    for _ in range(13):
        distance = np.hypot(u - rng.uniform(0.1, 0.9), v - rng.uniform(0.1, 0.9))
        for radius in rng.uniform(0.05, 0.2) * np.array([1.0, 0.68, 0.36]):
            image = np.where((distance < radius)[..., None], rng.uniform(0.1, 1.0, 3), image)
    return _framed(image, (0.75, 0.62, 0.30))


def _harbour(rng: np.random.Generator) -> np.ndarray:
    """Draw sails over water that mirrors the sky."""
    v, u = grid()
    image = lerp(np.array([0.55, 0.72, 0.90]), np.array([0.90, 0.88, 0.80]), v[..., None])
    ripple = 0.5 + 0.5 * np.sin(70 * v + 3 * noise(rng, slope=1.2, high=12))
    water = lerp(np.array([0.08, 0.28, 0.42]), np.array([0.35, 0.60, 0.70]), ripple[..., None])
    image = np.where((v > 0.6)[..., None], water, image)
    for x in rng.uniform(0.15, 0.85, 5):
        top = rng.uniform(0.18, 0.42)
        sail = (v > top) & (v < 0.6) & (np.abs(u - x) < 0.16 * (v - top))
        image = np.where(sail[..., None], rng.uniform(0.6, 1.0, 3), image)
        hull = (np.abs(v - 0.615) < 0.018) & (np.abs(u - x) < 0.09)
        image = np.where(hull[..., None], [0.30, 0.12, 0.08], image)
    return _framed(image, (0.45, 0.42, 0.40))


def _flowers(rng: np.random.Generator) -> np.ndarray:
    v, u = grid()
    image = np.broadcast_to([0.82, 0.78, 0.62], (TEXTURE_SIZE, TEXTURE_SIZE, 3))
    vase = (v > 0.6) & (v < 0.92) & (np.abs(u - 0.5) < 0.10 + 0.08 * np.sin(np.pi * (v - 0.6) / 0.32))
    image = np.where(vase[..., None], [0.18, 0.32, 0.55], image)
    for _ in range(16):
        at_u, at_v = rng.normal(0.5, 0.16), rng.normal(0.37, 0.11)
        stem = (
            (np.abs(u - lerp(at_u, 0.5, np.clip((v - at_v) / (0.62 - at_v), 0, 1))) < 0.006) & (v > at_v) & (v < 0.62)
        )
        image = np.where(stem[..., None], [0.15, 0.40, 0.15], image)
        angle, distance = np.arctan2(v - at_v, u - at_u), np.hypot(u - at_u, v - at_v)
        bloom = distance < rng.uniform(0.05, 0.09) * (0.8 + 0.2 * np.cos(rng.integers(5, 9) * angle))
        image = np.where(bloom[..., None], rng.uniform([0.6, 0.1, 0.1], [1.0, 0.8, 0.7]), image)
        image = np.where((distance < 0.018)[..., None], [0.35, 0.22, 0.05], image)
    return _framed(image, (0.55, 0.30, 0.12))


def _map(rng: np.random.Generator) -> np.ndarray:
    """Draw an old chart: continents in a sea with a graticule."""
    v, u = grid()
    height = noise(rng, slope=1.8, high=20)
    land = lerp(np.array([0.55, 0.66, 0.38]), np.array([0.80, 0.62, 0.38]), smooth_step(height, 0.3, 1.8)[..., None])
    image = np.where((height > 0.25)[..., None], land, [0.62, 0.76, 0.82])
    image = np.where((np.abs(height - 0.25) < 0.09)[..., None], [0.30, 0.28, 0.22], image)
    lines = (u * 8 % 1 < 0.06) | (v * 8 % 1 < 0.06)
    return _framed(np.where(lines[..., None], image * 0.82, image), (0.22, 0.22, 0.24))


def _books(rng: np.random.Generator) -> np.ndarray:
    """Draw two shelves of book spines of uneven width, height and colour."""
    image = np.full((TEXTURE_SIZE, TEXTURE_SIZE, 3), 0.12)
    for bottom in (TEXTURE_SIZE // 2, TEXTURE_SIZE):
        x = 0
        while x < TEXTURE_SIZE:
            width, height = int(rng.integers(5, 13)), int(rng.integers(42, 60))
            color = rng.uniform(0.12, 0.85, 3)
            spine = image[bottom - height : bottom - 2, x : x + width - 1]
            spine[:] = color
            spine[height // 8 : height // 8 + 4] = np.clip(color + rng.uniform(0.15, 0.4), 0, 1)
            if rng.uniform() < 0.6:
                spine[height // 2 : height // 2 + 9, 1:-1] = rng.uniform(0.6, 1.0, 3)
            x += width
    return image


def _window(rng: np.random.Generator) -> np.ndarray:
    """Draw four panes with a view of sky, roofs and trees between white bars."""
    v, u = grid()
    image = lerp(np.array([0.50, 0.70, 0.95]), np.array([0.88, 0.93, 0.98]), np.clip(v * 1.6, 0, 1)[..., None])
    clouds = smooth_step(noise(rng, slope=1.8, high=10, stretch=(2, 1)), 0.3, 1.4)
    image = lerp(image, np.array(1.0), clouds[..., None])
    crowns = 0.66 + 0.06 * noise(rng, slope=1.5, high=16)[0]
    trees = v > crowns
    foliage = np.array([0.20, 0.38, 0.16]) * (1 + 0.25 * noise(rng, slope=0.8, low=3))[..., None]
    image = np.where(trees[..., None], foliage, image)
    border = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
    bars = (border < 0.045) | (np.abs(u - 0.5) < 0.02) | (np.abs(v - 0.42) < 0.02)
    return np.clip(np.where(bars[..., None], 0.97, image), 0, 1)


def _leaves(rng: np.random.Generator) -> np.ndarray:
    """Draw overlapping green leaves with pale midribs; they repeat seamlessly."""
    v, u = grid()
    image = np.broadcast_to([0.06, 0.14, 0.05], (TEXTURE_SIZE, TEXTURE_SIZE, 3))
    for _ in range(90):
        dv, du = (v - rng.uniform() + 0.5) % 1 - 0.5, (u - rng.uniform() + 0.5) % 1 - 0.5
        angle, length = rng.uniform(0, 2 * np.pi), rng.uniform(0.06, 0.13)
        along, across = du * np.cos(angle) + dv * np.sin(angle), dv * np.cos(angle) - du * np.sin(angle)
        inside = (along / length) ** 2 + (across / (0.42 * length)) ** 2 < 1
        green = np.array([0.18, 0.45, 0.14]) * rng.uniform(0.6, 1.6) + [rng.uniform(0, 0.15), 0, 0]
        image = np.where(inside[..., None], np.clip(green, 0, 1), image)
        image = np.where((inside & (np.abs(across) < 0.006))[..., None], np.clip(green * 1.6, 0, 1), image)
    return image


def _screen(rng: np.random.Generator) -> np.ndarray:
    """Draw a display in a black bezel: a window, lines of text and a picture."""
    v, u = grid()
    glow = lerp(np.array([0.10, 0.20, 0.42]), np.array([0.45, 0.25, 0.55]), u[..., None])
    image = glow * (1 + 0.15 * noise(rng, slope=1.5, high=8))[..., None]
    page = (u > 0.12) & (u < 0.55) & (v > 0.14) & (v < 0.86)
    image = np.where(page[..., None], 0.92, image)
    ends = rng.uniform(0.2, 0.52, 14)[np.minimum((v * 18).astype(int), 13)]
    text = (v * 18 % 1 < 0.45) & (u > 0.15) & (u < ends) & (v > 0.2) & (v < 0.77)
    image = np.where(text[..., None], 0.25, image)
    photo = (np.abs(u - 0.75) < 0.14) & (np.abs(v - 0.38) < 0.18)
    image = np.where(
        photo[..., None], rng.uniform(0.2, 1.0, (8, 8, 3))[(v * 8).astype(int), (u * 8).astype(int)], image
    )
    border = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
    return np.clip(np.where((border < 0.03)[..., None], 0.04, image), 0, 1)


def _oven(rng: np.random.Generator) -> np.ndarray:
    """Draw knobs above a dark glass door with a bar handle."""
    v, u = grid()
    image = np.repeat((0.80 + 0.03 * noise(rng, slope=0.8, stretch=(1, 10)))[..., None], 3, axis=2)
    for x in np.linspace(0.15, 0.85, 5):
        image = np.where((np.hypot(u - x, v - 0.10) < 0.045)[..., None], 0.12, image)
    glass = (np.abs(u - 0.5) < 0.38) & (np.abs(v - 0.60) < 0.25)
    image = np.where(glass[..., None], np.array([0.10, 0.09, 0.10]) * (1 + 1.5 * (u + v))[..., None], image)
    image = np.where(((np.abs(v - 0.27) < 0.025) & (np.abs(u - 0.5) < 0.40))[..., None], 0.35, image)
    return np.clip(np.where((np.minimum(u, 1 - u) < 0.02)[..., None], 0.3, image), 0, 1)


PICTURES: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "painting_mountains": _mountains,
    "painting_blocks": _blocks,
    "painting_circles": _circles,
    "painting_harbour": _harbour,
    "painting_flowers": _flowers,
    "painting_map": _map,
    "books": _books,
    "window": _window,
    "leaves": _leaves,
    "screen": _screen,
    "oven": _oven,
}
"""Every picture by texture name."""
