"""Define procedural textures: `TEXTURES` maps a name to a function of a random generator, `texture_atlas` renders them.

A texture is a float array (TEXTURE_SIZE, TEXTURE_SIZE, 3) in [0, 1], row 0 at the top, that repeats seamlessly
(pictures excepted).
Surfaces are near white at their brightest, so that `Material.color` tints them; pictures carry their own colours.
Contrast sits where a small camera can see it, at a tenth to a hundredth of a tile, with tints that differ from plank to
plank and tile to tile: a floor of identical tiles would let a tracker slip by one tile. The generator of each name is
seeded by the name alone, so a texture never depends on which others are drawn.
"""

import zlib
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from vssm_gym.envs.textures.motifs import PICTURES
from vssm_gym.envs.textures.noise import TEXTURE_SIZE, cells, grid, lerp, noise, rgb, smooth_step

Texture = Callable[[np.random.Generator], np.ndarray]


def _plain(rng: np.random.Generator) -> np.ndarray:
    return rgb(0.97 + 0.01 * noise(rng, slope=1.0, high=32))


def _plaster(rng: np.random.Generator) -> np.ndarray:
    """Draw rolled paint: soft cloudy mottling with a faint grain."""
    value = 0.90 + 0.035 * noise(rng, slope=1.3, low=1, high=12) + 0.012 * noise(rng, slope=0.5, low=12, high=48)
    return rgb(value, warmth=0.02 * noise(rng, slope=1.5, high=6))


def _stucco(rng: np.random.Generator) -> np.ndarray:
    """Draw rough trowelled plaster: ridges at a tenth of a tile."""
    ridges = np.abs(noise(rng, slope=1.0, low=3, high=30))
    return rgb(0.93 - 0.11 * ridges + 0.03 * noise(rng, slope=1.0, high=8))


def _concrete(rng: np.random.Generator) -> np.ndarray:
    value = 0.78 + 0.07 * noise(rng, slope=1.2, high=40)
    pores = noise(rng, slope=0.4, low=6, high=40) > 2.3
    return rgb(np.where(pores, value - 0.3, value), warmth=0.01 * noise(rng, slope=1.5, high=5))


def _marble(rng: np.random.Generator) -> np.ndarray:
    """Draw bright stone crossed by thin dark veins: the zero lines of two smooth fields."""
    veins = np.exp(-np.abs(noise(rng, slope=1.7, high=24)) * 9) + 0.6 * np.exp(-np.abs(noise(rng, slope=1.7)) * 14)
    return rgb(0.93 - 0.42 * veins + 0.03 * noise(rng, slope=1.3, high=10), warmth=0.04 * veins)


def _granite(rng: np.random.Generator) -> np.ndarray:
    value = 0.68 + 0.06 * noise(rng, slope=1.0, high=16)
    value = np.where(noise(rng, slope=0.5, low=5, high=40) > 1.1, 0.35, value)
    return rgb(np.where(noise(rng, slope=0.5, low=5, high=40) > 1.4, 0.95, value))


def _grain(rng: np.random.Generator) -> np.ndarray:
    """Draw wood grain along x, zero mean: streaks, and rings that bend around slow knots."""
    streaks = noise(rng, slope=0.9, low=1, high=50, stretch=(1.0, 9.0))
    rings = np.sin(2 * np.pi * 2.2 * noise(rng, slope=1.9, high=16, stretch=(1.0, 5.0)))
    return 0.75 * streaks + 0.45 * rings


def _wood(rng: np.random.Generator) -> np.ndarray:
    grain = _grain(rng)
    return rgb(0.84 + 0.08 * grain, warmth=0.02 * grain)


def _boards(rng: np.random.Generator, rows: int, columns: int, spread: float) -> np.ndarray:
    shift = rng.uniform(0, 1, rows)
    board, edge = cells(rows, columns, shift)
    tint = rng.uniform(1 - spread, 1.0, rows * columns)[board]
    warmth = rng.uniform(-0.05, 0.05, rows * columns)[board]
    slide = rng.integers(0, TEXTURE_SIZE, rows * columns)[board]
    y, x = np.indices((TEXTURE_SIZE, TEXTURE_SIZE))
    grain = _grain(rng)[y, (x + slide) % TEXTURE_SIZE]
    joint = smooth_step(edge, 0.004, 0.012)
    return rgb(tint * (0.90 + 0.07 * grain) * lerp(0.45, 1.0, joint), warmth=warmth)


def _planks(rng: np.random.Generator) -> np.ndarray:
    return _boards(rng, rows=8, columns=2, spread=0.45)


def _laminate(rng: np.random.Generator) -> np.ndarray:
    return _boards(rng, rows=12, columns=4, spread=0.40)


def _parquet(rng: np.random.Generator) -> np.ndarray:
    """Draw a basket weave: squares of four strips that alternate in direction."""
    squares, strips = 6, 4
    v, u = grid()
    flip = (np.floor(u * squares) + np.floor(v * squares)) % 2 > 0
    along, across = np.where(flip, u, v) * squares, np.where(flip, v, u) * squares
    strip = np.floor(across * strips) % (squares * strips)
    index = (np.floor(along) * squares * strips + strip).astype(int) + flip * (squares * squares * strips)
    tint = rng.uniform(0.58, 1.0, 2 * squares * squares * strips)[index]
    edge = np.minimum.reduce(
        [along % 1 * strips, (1 - along % 1) * strips, across * strips % 1, 1 - across * strips % 1]
    )
    grain = _grain(rng)
    grain = np.where(flip, grain, grain.T)
    return rgb(tint * (0.92 + 0.06 * grain) * lerp(0.6, 1.0, smooth_step(edge, 0.03, 0.12)), warmth=0.05 * (tint - 0.8))


def _tiling(rng: np.random.Generator, rows: int, columns: int, shift: float, spread: float, grout: float) -> np.ndarray:
    tile, edge = cells(rows, columns, shift * (np.arange(rows) % 2))
    tint = rng.uniform(1 - spread, 1.0, rows * columns)[tile]
    warmth = rng.uniform(-0.04, 0.04, rows * columns)[tile]
    value = tint * (0.96 + 0.03 * noise(rng, slope=1.2, high=24))
    return rgb(lerp(grout, value, smooth_step(edge, 0.006, 0.012)), warmth=warmth)


def _tiles(rng: np.random.Generator) -> np.ndarray:
    return _tiling(rng, 5, 5, 0.0, spread=0.35, grout=0.5)


def _mosaic(rng: np.random.Generator) -> np.ndarray:
    return _tiling(rng, 10, 10, 0.0, spread=0.55, grout=0.9)


def _subway(rng: np.random.Generator) -> np.ndarray:
    return _tiling(rng, 8, 4, 0.5, spread=0.18, grout=0.5)


def _brick(rng: np.random.Generator) -> np.ndarray:
    bricks = _tiling(rng, 10, 4, 0.5, spread=0.45, grout=1.0)
    return np.clip(bricks * (0.95 + 0.07 * noise(rng, slope=0.6, low=4))[..., None], 0, 1)


def _checker(rng: np.random.Generator) -> np.ndarray:
    """Draw dark and light tiles in turn, no two of the same shade."""
    tile, edge = cells(6, 6, np.zeros(6))
    dark = (tile // 6 + tile % 6) % 2 > 0
    shade = np.where(dark, rng.uniform(0.15, 0.50, 36)[tile], rng.uniform(0.65, 1.0, 36)[tile])
    return rgb(shade * smooth_step(edge, 0.0, 0.008) * (0.96 + 0.05 * noise(rng, slope=1.3, high=20)))


def _hexagons(rng: np.random.Generator) -> np.ndarray:
    v, u = grid()
    centers = np.array([(i / 6, (j + 0.5 * (i % 2)) / 5) for i in range(6) for j in range(5)])
    offset = np.abs(np.stack([v, u], -1)[..., None, :] - centers)
    distance = np.linalg.norm(np.minimum(offset, 1 - offset), axis=-1)
    nearest, second = np.partition(distance, 1, axis=-1)[..., :2].transpose(2, 0, 1)
    tint = rng.uniform(0.55, 1.0, len(centers))[distance.argmin(-1)]
    return rgb(lerp(0.4, tint, smooth_step(second - nearest, 0.006, 0.014)) * (0.97 + 0.03 * noise(rng)))


def _carpet(rng: np.random.Generator) -> np.ndarray:
    """Draw pile: speckles of a twentieth of a tile on slow trodden patches."""
    pile = 0.09 * noise(rng, slope=0.3, low=8, high=34) + 0.08 * noise(rng, slope=1.4, high=7)
    return rgb(0.78 + pile, warmth=0.03 * noise(rng, slope=1.0, high=12))


def _rug(rng: np.random.Generator) -> np.ndarray:
    """Draw an oriental rug: borders around a field of diamonds, with its own colours."""
    v, u = grid()
    border = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v))
    diamonds = np.floor((np.abs(u - 0.5) + np.abs(v - 0.5)) * 11).astype(int)
    palette = np.array(
        [[0.50, 0.10, 0.12], [0.85, 0.72, 0.50], [0.12, 0.16, 0.35], [0.62, 0.24, 0.14], [0.90, 0.85, 0.70]]
    )
    color = palette[rng.integers(0, 5, 12)[diamonds]]
    flower, _ = cells(16, 16, np.zeros(16))
    color = np.where((rng.uniform(size=256) < 0.22)[flower][..., None], palette[rng.integers(0, 5, 256)[flower]], color)
    color = np.where((border < 0.16)[..., None], palette[rng.integers(0, 5, 256)[flower]], color)
    color = np.where(((border < 0.17) & (border > 0.145) | (border < 0.02))[..., None], palette[2], color)
    return np.clip(color * (0.93 + 0.10 * noise(rng, slope=0.4, low=6))[..., None], 0, 1)


def _fabric(rng: np.random.Generator) -> np.ndarray:
    """Draw upholstery: a coarse weave with slubs along both threads."""
    slubs = noise(rng, slope=0.5, low=3, high=40, stretch=(1, 6)) + noise(
        rng, slope=0.5, low=3, high=40, stretch=(6, 1)
    )
    return rgb(0.80 + 0.075 * slubs + 0.05 * noise(rng, slope=1.4, high=8))


def _plaid(rng: np.random.Generator) -> np.ndarray:
    threads = rng.uniform(0.45, 0.95, (2, 16, 1)) + rng.uniform(-0.08, 0.08, (2, 16, 3))
    index = np.arange(TEXTURE_SIZE) * 16 // TEXTURE_SIZE
    color = (threads[0, index][:, None] + threads[1, index][None]) / 2
    return np.clip(color * (0.97 + 0.04 * noise(rng, slope=0.3, low=8))[..., None], 0, 1)


def _leather(rng: np.random.Generator) -> np.ndarray:
    creases = np.exp(-6 * np.abs(noise(rng, slope=0.9, low=3, high=28)))
    return rgb(0.86 - 0.28 * creases + 0.06 * noise(rng, slope=1.4, high=6))


def _wicker(rng: np.random.Generator) -> np.ndarray:
    v, u = grid()
    over = (np.floor(u * 12) + np.floor(v * 12)) % 2 > 0
    bulge = np.where(over, np.sin(np.pi * (u * 12 % 1)), np.sin(np.pi * (v * 12 % 1)))
    strand, _ = cells(12, 12, np.zeros(12))
    return rgb((0.5 + 0.45 * bulge) * rng.uniform(0.7, 1.0, 144)[strand])


def _wallpaper(rng: np.random.Generator) -> np.ndarray:
    """Draw blossoms on stems in a half-drop repeat; each blossom has its own size and shade."""
    v, u = grid()
    value = 0.93 + 0.015 * noise(rng, slope=1.0, high=12)
    color = np.repeat(value[..., None], 3, axis=2)
    for column in range(4):
        stem = np.abs((u - (column + 0.5) / 4 - 0.03 * np.sin(4 * np.pi * v) + 0.5) % 1 - 0.5)
        color = np.where((stem < 0.008)[..., None], [0.60, 0.72, 0.55], color)
        for row in range(4):
            at_v = (row + 0.5 * (column % 2) + 0.25) / 4
            at_u = (column + 0.5) / 4 + 0.03 * np.sin(4 * np.pi * at_v)
            dv, du = (v - at_v + 0.5) % 1 - 0.5, (u - at_u + 0.5) % 1 - 0.5
            petals = rng.uniform(0.045, 0.085) * (0.75 + 0.25 * np.cos(rng.integers(4, 8) * np.arctan2(dv, du)))
            bloom = np.hypot(dv, du) < petals
            shade = np.array([0.80, 0.55, 0.50]) + rng.uniform(-0.18, 0.18, 3)
            color = np.where(bloom[..., None], shade, color)
            color = np.where((np.hypot(dv, du) < 0.018)[..., None], [0.90, 0.78, 0.40], color)
    return np.clip(color, 0, 1)


def _stripes(rng: np.random.Generator) -> np.ndarray:
    """Draw vertical wallpaper stripes of uneven width and shade."""
    widths = rng.uniform(0.5, 2.0, 14)
    stripe = np.searchsorted(np.cumsum(widths) / widths.sum(), (np.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE)
    shade = np.where(np.arange(14) % 2 > 0, rng.uniform(0.62, 0.80, 14), rng.uniform(0.88, 1.0, 14))
    return rgb(np.broadcast_to(shade[stripe], (TEXTURE_SIZE, TEXTURE_SIZE)) + 0.02 * noise(rng, slope=1.2, high=16))


def _wainscot(rng: np.random.Generator) -> np.ndarray:
    """Draw a panelled lower third, a dado rail and mottled paint above; meant for ``scale`` = the wall's height."""
    v, u = grid()
    up = 1 - v
    panel = np.minimum(np.abs((u * 5) % 1 - 0.5) * 2, np.abs(up / 0.36 - 0.5) * 2)
    frame = np.maximum(np.abs((u * 5) % 1 - 0.5) * 2, np.abs(up / 0.36 - 0.5) * 2)
    wood = 0.82 + 0.05 * _grain(rng).T - 0.25 * ((frame > 0.72) & (frame < 0.78)) + 0.03 * panel
    paint = 0.92 + 0.03 * noise(rng, slope=1.3, high=12)
    value = np.where(up < 0.36, wood, np.where(up < 0.385, 0.62, paint))
    return rgb(value, warmth=np.where(up < 0.385, 0.05, 0.0))


def _metal(rng: np.random.Generator) -> np.ndarray:
    return rgb(0.84 + 0.05 * noise(rng, slope=0.8, stretch=(1, 12)) + 0.04 * noise(rng, slope=1.5, high=5))


def _cabinet(rng: np.random.Generator) -> np.ndarray:
    """Draw two panelled cabinet doors side by side with handles towards the middle."""
    v, u = grid()
    frame = np.maximum(np.abs((u * 2) % 1 - 0.5) * 2, np.abs(v - 0.5) * 2)
    value = 0.88 + 0.05 * _grain(rng).T - 0.30 * (frame > 0.965) - 0.16 * ((frame > 0.70) & (frame < 0.75))
    handle = (np.abs(np.abs(u - 0.5) - 0.055) < 0.015) & (np.abs(v - 0.45) < 0.07)
    return rgb(np.where(handle, 0.25, value))


def _drawers(rng: np.random.Generator) -> np.ndarray:
    """Draw four drawers, each with a long handle."""
    v, u = grid()
    row = v * 4 % 1
    value = 0.86 + 0.06 * _grain(rng) + rng.uniform(-0.06, 0.06, 4)[(v * 4).astype(int)]
    value = value - 0.35 * ((row < 0.05) | (row > 0.95) | (np.abs(u - 0.5) > 0.485))
    return rgb(np.where((np.abs(row - 0.4) < 0.05) & (np.abs(u - 0.5) < 0.14), 0.22, value))


TEXTURES: dict[str, Texture] = {
    "plain": _plain,
    "plaster": _plaster,
    "stucco": _stucco,
    "concrete": _concrete,
    "marble": _marble,
    "granite": _granite,
    "wood": _wood,
    "planks": _planks,
    "laminate": _laminate,
    "parquet": _parquet,
    "tiles": _tiles,
    "mosaic": _mosaic,
    "subway": _subway,
    "brick": _brick,
    "checker": _checker,
    "hexagons": _hexagons,
    "carpet": _carpet,
    "rug": _rug,
    "fabric": _fabric,
    "plaid": _plaid,
    "leather": _leather,
    "wicker": _wicker,
    "wallpaper": _wallpaper,
    "stripes": _stripes,
    "wainscot": _wainscot,
    "metal": _metal,
    "cabinet": _cabinet,
    "drawers": _drawers,
    **PICTURES,
}
"""Every texture by name."""


@cache
def _render(name: str) -> np.ndarray:
    image = TEXTURES[name](np.random.default_rng(zlib.crc32(name.encode())))
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def texture_atlas(names: Sequence[str]) -> np.ndarray:
    """Render the named textures as uint8 ``(n, TEXTURE_SIZE, TEXTURE_SIZE, 3)``, row 0 at the top.

    A name always gives the same bytes.
    """
    return np.stack([_render(name) for name in names])
