"""Shade visible faces in one compiled pass: texture coordinates, mip-mapped textures, and light.

    rgb = colour texture(u, v) (ambient + lamp (1 + n.l) / 2 + head cos / (1 + (distance / range)^2))

A distant lamp from above makes faces of different direction distinguishable, and a weak lamp at the camera shows
distance; there are no shadows. Textures are sampled trilinearly from their mips at the size of the pixel's footprint,
so that distant surfaces do not shimmer: an image that a tracker compares must change as little as the view does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from vssm_gym.envs.rendering.raster import SIDES
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.envs.textures.registry import texture_atlas

AMBIENT, LAMP, HEAD = 0.50, 0.38, 0.14  # shares of the light; they add up to just above 1
LAMP_DIRECTION = (0.35, 0.22, 0.91)  # world, towards the lamp, unit length to two digits
HEAD_RANGE = 3.0  # m at which the head lamp has half its strength
SKY = (0.62, 0.75, 0.90)  # colour where a ray leaves the apartment


@dataclass(frozen=True)
class Looks:
    """Hold the colours and textures of ``n`` boxes as the shader reads them.

    Attributes:
        shifts: float64 ``(n, 6)``, m: :func:`texture_shifts`.
        colors: float32 ``(n, 4)``: red, green, blue, tiles a metre.
        textures: int64 ``(n,)``: where each box's texture starts in ``texels``.
        texels: uint64, all textures with their mips: a byte each of red, green and blue in lanes of 21 bits. The first
            texture is white.
        levels: levels of a texture, from one texel up.
    """

    shifts: np.ndarray
    colors: np.ndarray
    textures: np.ndarray
    texels: np.ndarray
    levels: int


def looks_of(boxes: Sequence[SolidBox]) -> Looks:
    """Build the shader's tables for ``boxes``."""
    names = sorted({box.material.texture for box in boxes})
    shifts = np.array([sum(texture_shifts(box), ()) for box in boxes], dtype=np.float64)
    colors = np.array([(*box.material.color, 1.0 / box.material.scale) for box in boxes], dtype=np.float32)
    white = np.full((1, *texture_atlas(names).shape[1:]), 255, dtype=np.uint8)  # of the sky
    texels, levels = _mips(np.concatenate([white, texture_atlas(names)]))
    assert levels > 1  # a pixel blends two of them
    textures = texels.shape[1] * np.array([1 + names.index(box.material.texture) for box in boxes], dtype=np.int64)
    return Looks(shifts, colors, textures, texels.ravel(), levels)


def texture_shifts(box: SolidBox) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the offsets of a box's patterns, m along its axes.

    Those that turn with the face's direction, and the others.
    """
    if box.kind in ("wall", "floor", "ceiling"):
        # One pattern runs through all the pieces of a wall or floor: it starts at the world's origin.
        c, s = math.cos(box.yaw), math.sin(box.yaw)
        x, y, z = box.center
        return (c * x + s * y, c * y - s * x, z), (0.0, 0.0, 0.0)
    # Each face's pattern starts at its upper left corner.
    return (0.0, 0.0, 0.0), (0.5 * box.size[0], 0.5 * box.size[1], 0.5 * box.size[2])


def _lanes(colors: np.ndarray) -> np.ndarray:
    """Pack ``(..., 3)`` in [0, 255] as bytes in lanes of 21 bits: one multiplication weighs three colours at once."""
    return (np.rint(colors).astype(np.uint64) << np.array([0, 21, 42], dtype=np.uint64)).sum(axis=-1, dtype=np.uint64)


def _mips(atlas: np.ndarray) -> tuple[np.ndarray, int]:
    """Return each texture's mips, from its mean to itself.

    Uint8 ``(n, size, size, 3)`` to uint64 ``(n, sum of size^2)``.
    """
    level, flat = atlas.astype(np.float64), []
    while True:
        n, size = level.shape[:2]
        flat.append(_lanes(level).reshape(n, size * size))
        if size == 1:
            return np.concatenate(flat[::-1], axis=1), len(flat)
        level = level.reshape(n, size // 2, 2, size // 2, 2, 3).mean(axis=(2, 4))


@numba.njit(nogil=True, cache=True, inline="always")
def _log2(x):
    """Return ``log2(x)`` of a positive number to 0.09, continuous and monotone: its exponent plus its mantissa."""
    bits = np.float32(x).view(np.int32)
    return np.float32((bits >> 23) - 127) + np.float32(bits & 0x7FFFFF) * np.float32(2.0**-23)


@numba.njit(nogil=True, cache=True, inline="always")
def _byte(value):
    return np.uint8(np.int32(min(np.float32(255.0), np.float32(value) + np.float32(0.5))))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _describe(T, fx, fy, cx, cy, frame, shift, color, axis, sign, row):
    """Write what all pixels of one face share into ``row`` (14,).

    ``u = row[0] + z (row[1] + row[2] i + row[3] j)`` tiles, ``v`` alike from ``row[4]``; ``row[8]``: m from the camera
    to the face's plane; ``row[9]``: light of sky and lamp; ``row[10]``: tiles^2 a pixel at depth 1; colour from 11 on.
    """
    c, s = frame[6], frame[7]
    dx, dy, dz = T[0, 3] - frame[0], T[1, 3] - frame[1], T[2, 3] - frame[2]
    eye = (c * dx + s * dy, c * dy - s * dx, dz)  # in the box's frame
    # Texture u runs to the right and v down as seen from outside, so that no painting is mirrored.
    if axis == 0:
        ux, uy, uz, u0 = 0.0, sign, 0.0, sign * shift[1] + shift[4]
        vx, vy, vz, v0 = 0.0, 0.0, -1.0, shift[5] - shift[2]
        nx, ny, nz = sign * c, sign * s, 0.0
    elif axis == 1:
        ux, uy, uz, u0 = -sign, 0.0, 0.0, shift[3] - sign * shift[0]
        vx, vy, vz, v0 = 0.0, 0.0, -1.0, shift[5] - shift[2]
        nx, ny, nz = -sign * s, sign * c, 0.0
    else:
        ux, uy, uz, u0 = 1.0, 0.0, 0.0, shift[0] + shift[3]
        vx, vy, vz, v0 = 0.0, -1.0, 0.0, shift[4] - shift[1]
        nx, ny, nz = 0.0, 0.0, sign
    tiles = np.float64(color[3])
    for which in range(2):
        x, y, z, start = (ux, uy, uz, u0) if which == 0 else (vx, vy, vz, v0)
        at = tiles * (x * eye[0] + y * eye[1] + z * eye[2] + start)
        wx, wy = tiles * (c * x - s * y), tiles * (s * x + c * y)  # world frame
        right = (wx * T[0, 0] + wy * T[1, 0] + tiles * z * T[2, 0]) / fx
        down = (wx * T[0, 1] + wy * T[1, 1] + tiles * z * T[2, 1]) / fy
        ahead = wx * T[0, 2] + wy * T[1, 2] + tiles * z * T[2, 2]
        row[4 * which] = at - np.floor(at)
        row[4 * which + 1] = ahead - right * cx - down * cy
        row[4 * which + 2], row[4 * which + 3] = right, down
    row[8] = abs(sign * eye[axis] - frame[3 + axis])
    slant = nx * LAMP_DIRECTION[0] + ny * LAMP_DIRECTION[1] + nz * LAMP_DIRECTION[2]
    row[9] = AMBIENT + 0.5 * LAMP * (1.0 + slant)
    row[10] = tiles * tiles / (fx * fy)
    row[11], row[12], row[13] = color[0], color[1], color[2]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def shade(T, fx, fy, cx, cy, frames, shifts, colors, textures, texels, levels, length2, nearness, face, rgb, depth):
    """Compute colour and depth of the faces that :func:`vssm_gym.envs.rendering.raster.draw` has drawn.

    Each row is cut into runs of pixels that show one face, and the work into loops that the compiler can vectorise;
    only the texels are fetched one pixel after another.

    Args:
        T: camera to world, float64 ``(4, 4)``.
        fx, fy, cx, cy: intrinsics, pixels.
        frames: :func:`vssm_gym.envs.rendering.raster.box_frames`.
        shifts, colors, textures, texels, levels: of :class:`Looks`.
        length2: float32 ``(H, W)``, squared length of ``K^-1 [i, j, 1]``.
        nearness, face: as drawn, ``(H, W)``.
        rgb: uint8 ``(H, W, 3)``, written.
        depth: float32 ``(H, W)``, written: z, m, 0 where nothing is seen.
    """
    height, width = nearness.shape
    sky = SIDES * frames.shape[0]
    rows, described = np.empty((sky + 1, 14), dtype=np.float32), np.zeros(sky, dtype=np.bool_)
    starts = np.zeros(sky + 1, dtype=np.uint64)  # of the faces' textures
    rows[sky], rows[sky, 9] = 0.0, 1.0
    rows[sky, 11], rows[sky, 12], rows[sky, 13] = SKY
    # One row's work. They are no rows of a common array, so that the compiler knows that they do not overlap.
    u, v, level = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    away, steady, texel2 = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    light, shown, mixed = np.empty(width, np.float32), np.empty(width, np.uint64), np.empty(width, np.uint64)
    fine_upper, fine_lower, fine = np.empty(width, np.uint64), np.empty(width, np.uint64), np.empty(width, np.uint64)
    wide_upper, wide_lower, wide = np.empty(width, np.uint64), np.empty(width, np.uint64), np.empty(width, np.uint64)
    for j in range(height):
        i = 0
        while i < width:
            f, end = face[j, i], i + 1
            while end < width and face[j, end] == f:
                end += 1
            if f < 0:
                f = sky
                for k in range(i, end):
                    depth[j, k] = u[k] = v[k] = np.float32(0.0)
            else:
                if not described[f]:
                    described[f] = True
                    box, sign = f // SIDES, 2.0 * (f % 2) - 1.0
                    starts[f] = textures[box]
                    _describe(T, fx, fy, cx, cy, frames[box], shifts[box], colors[box], (f % SIDES) // 2, sign, rows[f])
                _place(i, end, j, rows[f], nearness[j], u, v, depth[j])
            _spread(i, end, f, rows[f], away, steady, texel2, shown)
            i = end
        _light(away, steady, texel2, levels, length2[j], depth[j], level, light)
        _find(levels, 0, u, v, level, fine_upper, fine_lower)
        _find(levels, 1, u, v, level, wide_upper, wide_lower)
        _weigh(levels, u, v, level, fine, wide)
        _fetch(texels, starts, shown, fine_upper, fine_lower, fine, wide_upper, wide_lower, wide, mixed)
        _paint(mixed, light, rows, shown, rgb[j])


_WHOLE = 1 << 13  # the sum of a pixel's eight weights: 8 bits of colour and 13 of weight fill a lane


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _place(first, end, j, row, nearness, u, v, depth):
    """Compute depth, and texture coordinates in [0, 1), of a run of pixels that show one face."""
    u0, uz, ux = row[0], row[1] + row[3] * np.float32(j), row[2]
    v0, vz, vx = row[4], row[5] + row[7] * np.float32(j), row[6]
    for i in range(first, end):
        x, z = np.float32(i), np.float32(1.0) / nearness[i]
        a, b = u0 + z * (uz + ux * x), v0 + z * (vz + vx * x)
        depth[i] = z
        u[i], v[i] = a - np.floor(a), b - np.floor(b)


@numba.njit(nogil=True, cache=True)
def _spread(first, end, f, row, away, steady, texel2, shown):
    """Copy what a face's pixels share to each pixel of a run."""
    for i in range(first, end):
        away[i], steady[i], texel2[i] = row[8], row[9], row[10]
    for i in range(first, end):
        shown[i] = f


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _light(away, steady, texel2, levels, length2, depth, level, light):
    """Compute level of detail, 0 for one texel, and light of a row."""
    one, zero, finest = np.float32(1.0), np.float32(0.0), np.float32(levels - 1)
    head, fade = np.float32(HEAD), np.float32(1.0 / HEAD_RANGE**2)
    for i in range(level.shape[0]):
        distance2 = depth[i] * depth[i] * length2[i]
        cosine = min(one, away[i] / np.sqrt(max(distance2, np.float32(1e-12))))
        # On the axis a pixel covers distance / f metres across and 1 / cosine as much along: the level suits their
        # geometric mean. Off the axis it covers less: towards the corners of wide images textures are a bit soft.
        footprint2 = distance2 * texel2[i] / max(cosine, np.float32(0.02))
        detail = np.float32(-0.5) * _log2(max(footprint2, np.float32(1e-12)))
        level[i] = min(max(detail, zero), finest)
        light[i] = steady[i] + head * cosine / (one + distance2 * fade)


@numba.njit(nogil=True, cache=True)
def _find(levels, coarser, u, v, level, upper, lower):
    """Find the four texels around each texture coordinate, in the finer level or the ``coarser`` one.

    Two indices are packed in a word of 64 bits. Texel centres are at half integers; tiles repeat.
    """
    one = np.int32(1)
    for i in range(level.shape[0]):
        bits = min(np.int32(level[i]), np.int32(levels - 2)) + np.int32(1 - coarser)
        size = one << bits
        # A whole tile on, so that truncation rounds down.
        shift = np.float32(size) - np.float32(0.5)
        x, y = np.int32(u[i] * np.float32(size) + shift), np.int32(v[i] * np.float32(size) + shift)
        mask = size - one
        start = np.int32(0x55555555) & ((one << (bits + bits)) - one)  # (4^bits - 1) / 3 texels of coarser levels
        row0, row1 = start + ((y & mask) << bits), start + (((y + one) & mask) << bits)
        c0, c1 = x & mask, (x + one) & mask
        upper[i] = np.uint64(row0 + c0) | (np.uint64(row0 + c1) << np.uint64(32))
        lower[i] = np.uint64(row1 + c0) | (np.uint64(row1 + c1) << np.uint64(32))


@numba.njit(nogil=True, cache=True)
def _weigh(levels, u, v, level, fine, wide):
    """Compute the weights of these texels, bilinear within a level and linear between two.

    Four a word, ``_WHOLE`` in all.
    """
    one, half = np.float32(1.0), np.float32(0.5)
    for i in range(level.shape[0]):
        below = min(np.int32(level[i]), np.int32(levels - 2))
        share = np.int32((level[i] - np.float32(below)) * np.float32(_WHOLE))  # of the finer level
        for which in range(2):
            size = np.float32(np.int32(1) << (below + np.int32(1 - which)))
            part = share if which == 0 else np.int32(_WHOLE) - share
            x, y = u[i] * size + half, v[i] * size + half
            a, b = x - np.floor(x), y - np.floor(y)
            total = np.float32(part)
            w01, w10, w11 = np.int32(total * a * (one - b)), np.int32(total * (one - a) * b), np.int32(total * a * b)
            w00 = part - w01 - w10 - w11
            upper = np.uint64(w00) | (np.uint64(w01) << np.uint64(16))
            lower = (np.uint64(w10) << np.uint64(32)) | (np.uint64(w11) << np.uint64(48))
            if which == 0:
                fine[i] = upper | lower
            else:
                wide[i] = upper | lower


@numba.njit(nogil=True, cache=True)
def _fetch(texels, starts, shown, fine_upper, fine_lower, fine, wide_upper, wide_lower, wide, mixed):
    """Sum eight weighted texels for each pixel, lane by lane."""
    for i in range(mixed.shape[0]):
        start = starts[shown[i]]
        mixed[i] = _four(texels, start, fine_upper[i], fine_lower[i], fine[i]) + _four(
            texels, start, wide_upper[i], wide_lower[i], wide[i]
        )


@numba.njit(nogil=True, cache=True, inline="always")
def _four(texels, start, upper, lower, w):
    half, quarter, low, short = np.uint64(32), np.uint64(16), np.uint64(0xFFFFFFFF), np.uint64(0xFFFF)
    above = texels[start + (upper & low)] * (w & short) + texels[start + (upper >> half)] * ((w >> quarter) & short)
    below = texels[start + (lower & low)] * ((w >> half) & short)
    return above + below + texels[start + (lower >> half)] * (w >> (half + quarter))


@numba.njit(nogil=True, cache=True)
def _paint(mixed, light, rows, shown, rgb):
    """Write the bytes of the mixed texels times the face's colour and the light."""
    mask, lane, share = np.uint64((1 << 21) - 1), np.uint64(21), np.float32(1.0 / _WHOLE)
    for i in range(mixed.shape[0]):
        f, bright = shown[i], share * light[i]
        r, g, b = mixed[i] & mask, (mixed[i] >> lane) & mask, mixed[i] >> (lane + lane)
        rgb[i, 0] = _byte(np.float32(np.int32(r)) * (bright * rows[f, 11]))
        rgb[i, 1] = _byte(np.float32(np.int32(g)) * (bright * rows[f, 12]))
        rgb[i, 2] = _byte(np.float32(np.int32(b)) * (bright * rows[f, 13]))
