"""Colours of ray hits: box-face texture coordinates, mip-mapped textures, and light, in one compiled pass.

    rgb = colour texture(u, v) (ambient + lamp (1 + n.l) / 2 + head cos / (1 + (distance / range)^2))

A distant lamp from above tells faces of different direction apart, a weak lamp on the head gives some depth; there are
no shadows. Textures are sampled trilinearly from their mips at the size of the pixel's footprint, so that distant
surfaces do not shimmer: images that a tracker compares must change as little as the view does.
"""

import math
from collections.abc import Sequence

import numba
import numpy as np

from vssm_gym.envs.solids import SolidBox
from vssm_gym.envs.textures import texture_atlas

AMBIENT, LAMP, HEAD = 0.50, 0.38, 0.14  # shares of the light; they add up to just above 1
LAMP_DIRECTION = (0.35, 0.22, 0.91)  # world, towards the lamp, unit length to two digits
HEAD_RANGE = 3.0  # m at which the head lamp has half its strength
SKY = (0.62, 0.75, 0.90)  # colour where a ray leaves the apartment


def shading_tables(boxes: Sequence[SolidBox]) -> tuple[np.ndarray, ...]:
    """Boxes as the shader reads them.

    Returns:
        frames float64 ``(n, 14)``: centre, 1 / half size, cos and sin of yaw, then the shifts of texture coordinates
        along the box's axes, one that turns with a face's direction and one that does not;
        looks float64 ``(n, 4)``: colour, tiles a metre; textures int32 ``(n,)``: rows of the mips;
        mips float32 ``(textures, texels of all levels, 4)`` in [0, 255]; starts int32 ``(levels,)``.
    """
    names = sorted({box.material.texture for box in boxes})
    frames, looks = np.empty((len(boxes), 14)), np.empty((len(boxes), 4))
    textures = np.array([names.index(box.material.texture) for box in boxes], dtype=np.int32)
    for i, box in enumerate(boxes):
        c, s = math.cos(box.yaw), math.sin(box.yaw)
        x, y, z = box.center
        origin, corner = texture_shifts(box)
        frames[i] = (x, y, z, *(2.0 / extent for extent in box.size), c, s, *origin, *corner)
        looks[i] = (*box.material.color, 1.0 / box.material.scale)
    return frames.astype(np.float32), looks.astype(np.float32), textures, *_mips(texture_atlas(names))


def texture_shifts(box: SolidBox) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Where a box's patterns start, m along its axes: shifts that turn with the face's direction, and others."""
    if box.kind in ("wall", "floor", "ceiling"):
        # One pattern runs through all the pieces of a wall or floor: it starts at the world's origin.
        c, s = math.cos(box.yaw), math.sin(box.yaw)
        x, y, z = box.center
        return (c * x + s * y, c * y - s * x, z), (0.0, 0.0, 0.0)
    # Each face's pattern starts at its upper left corner.
    return (0.0, 0.0, 0.0), (0.5 * box.size[0], 0.5 * box.size[1], 0.5 * box.size[2])


def _mips(atlas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each texture, then its halves down to one texel, and where each level starts.

    uint8 ``(n, size, size, 3)`` to float32 ``(n, sum of size^2, 4)``: a texel is one aligned load.
    """
    level = atlas.astype(np.float32)
    flat, starts = [], [0]
    while True:
        n, size = level.shape[:2]
        texels = np.zeros((n, size * size, 4), dtype=np.float32)
        texels[..., :3] = level.reshape(n, size * size, 3)
        flat.append(texels)
        if size == 1:
            return np.concatenate(flat, axis=1), np.array(starts, dtype=np.int32)
        starts.append(starts[-1] + size * size)
        level = level.reshape(n, size // 2, 2, size // 2, 2, 3).mean(axis=(2, 4))


@numba.njit(nogil=True, cache=True)
def rotate(T, rays, directions):
    """``directions = R rays``; float32 rows."""
    R = T.astype(np.float32)
    for i in range(rays.shape[0]):
        for k in range(3):
            directions[i, k] = R[k, 0] * rays[i, 0] + R[k, 1] * rays[i, 1] + R[k, 2] * rays[i, 2]


@numba.njit(nogil=True, cache=True, inline="always")
def _log2(x):
    """``log2(x)`` of a positive number to 0.09, continuous and rising: its exponent plus its mantissa."""
    bits = np.float32(x).view(np.int32)
    return np.float32((bits >> 23) - 127) + np.float32(bits & 0x7FFFFF) * np.float32(2.0**-23)


@numba.njit(nogil=True, cache=True, inline="always")
def _bilinear(texels, start, size, u, v):
    """Red, green, blue of one level at tile coordinates ``(u, v)`` in [0, 1): centres at half integers, tiles repeat.

    Unsigned indices spare the compiler its test for indices that count from the end.
    """
    shift = np.float32(size) - np.float32(0.5)  # a whole tile on, so that truncation rounds down
    x, y = u * np.float32(size) + shift, v * np.float32(size) + shift
    x0, y0 = np.int32(x), np.int32(y)
    a, b = x - np.float32(x0), y - np.float32(y0)
    mask = np.int32(size - 1)
    row0 = np.uintp(start) + np.uintp(y0 & mask) * np.uintp(size)
    row1 = np.uintp(start) + np.uintp((y0 + 1) & mask) * np.uintp(size)
    c0, c1 = np.uintp(x0 & mask), np.uintp((x0 + 1) & mask)
    one, r, g, b_ = np.float32(1.0), np.uintp(0), np.uintp(1), np.uintp(2)
    w00, w01, w10, w11 = (one - a) * (one - b), a * (one - b), (one - a) * b, a * b
    i00, i01, i10, i11 = row0 + c0, row0 + c1, row1 + c0, row1 + c1
    return (
        w00 * texels[i00, r] + w01 * texels[i01, r] + w10 * texels[i10, r] + w11 * texels[i11, r],
        w00 * texels[i00, g] + w01 * texels[i01, g] + w10 * texels[i10, g] + w11 * texels[i11, g],
        w00 * texels[i00, b_] + w01 * texels[i01, b_] + w10 * texels[i10, b_] + w11 * texels[i11, b_],
    )


@numba.njit(nogil=True, cache=True, inline="always")
def _byte(value):
    return np.uint8(np.int32(min(np.float32(255.0), np.float32(value) + np.float32(0.5))))


@numba.njit(nogil=True, cache=True, error_model="numpy", fastmath={"contract", "arcp", "nsz", "reassoc"})
def shade(T, directions, t, box, pixels, frames, looks, textures, mips, starts, pixel, rgb):
    """``rgb = colour texture(u, v) (ambient + lamp (1 + n.l) / 2 + head cos / (1 + (distance / range)^2))`` of hits.

    ``pixels`` are the rays' places in ``rgb (pixels, 3)``; ``starts`` the first texels of the mips' levels; ``pixel``
    the pixels' width at depth 1.
    """
    one, zero, half = np.float32(1.0), np.float32(0.0), np.float32(0.5)
    levels = starts.shape[0]
    top = np.float32(levels - 1)
    pixel2 = np.float32(pixel * pixel)
    ox, oy, oz = np.float32(T[0, 3]), np.float32(T[1, 3]), np.float32(T[2, 3])
    lx, ly, lz = np.float32(LAMP_DIRECTION[0]), np.float32(LAMP_DIRECTION[1]), np.float32(LAMP_DIRECTION[2])
    ambient, lamp, head = np.float32(AMBIENT + 0.5 * LAMP), np.float32(0.5 * LAMP), np.float32(HEAD)
    fade = np.float32(1.0 / HEAD_RANGE**2)
    for i in range(t.shape[0]):
        at = np.uintp(pixels[i])
        if box[i] < 0:
            rgb[at, 0], rgb[at, 1], rgb[at, 2] = _byte(255.0 * SKY[0]), _byte(255.0 * SKY[1]), _byte(255.0 * SKY[2])
            continue
        k = np.uintp(box[i])
        dx, dy, dz, d = directions[i, 0], directions[i, 1], directions[i, 2], t[i]
        # The hit in the box's frame, and how near each pair of faces it is (1 on a face).
        c, s = frames[k, 6], frames[k, 7]
        px, py = ox + d * dx - frames[k, 0], oy + d * dy - frames[k, 1]
        x, y, z = c * px + s * py, c * py - s * px, oz + d * dz - frames[k, 2]
        rx, ry, rz = abs(x) * frames[k, 3], abs(y) * frames[k, 4], abs(z) * frames[k, 5]
        # Texture u runs to the right and v down as seen from outside, so that no painting is mirrored.
        if rx >= ry and rx >= rz:
            sign = one if x > zero else -one
            nx, ny, nz = sign * c, sign * s, zero
            u, v = sign * (y + frames[k, 9]) + frames[k, 12], frames[k, 13] - z - frames[k, 10]
        elif ry >= rz:
            sign = one if y > zero else -one
            nx, ny, nz = -sign * s, sign * c, zero
            u, v = frames[k, 11] - sign * (x + frames[k, 8]), frames[k, 13] - z - frames[k, 10]
        else:
            nx, ny, nz = zero, zero, (one if z > zero else -one)
            u, v = x + frames[k, 8] + frames[k, 11], frames[k, 12] - y - frames[k, 9]
        length2 = dx * dx + dy * dy + dz * dz
        cosine = min(one, abs(dx * nx + dy * ny + dz * nz) / np.sqrt(length2))
        distance2 = d * d * length2

        # A pixel covers `pixel distance` metres across, 1 / cosine as much along: the level suits their geometric mean.
        tiles = looks[k, 3]
        footprint2 = distance2 * pixel2 * tiles * tiles / max(cosine, np.float32(0.02))
        level = top + half * _log2(max(footprint2, np.float32(1e-12)))
        level = min(max(level, zero), top)
        lower = np.int32(level)
        blend = level - np.float32(lower)
        size = np.int32(1) << (np.int32(levels - 1) - lower)
        u, v = u * tiles, v * tiles
        u, v = u - np.floor(u), v - np.floor(v)
        texels = mips[np.uintp(textures[k])]
        red, green, blue = _bilinear(texels, starts[lower], size, u, v)
        if blend > zero:
            r, g, b = _bilinear(texels, starts[lower + 1], size >> 1, u, v)
            red, green, blue = red + blend * (r - red), green + blend * (g - green), blue + blend * (b - blue)

        light = ambient + lamp * (nx * lx + ny * ly + nz * lz) + head * cosine / (one + distance2 * fade)
        rgb[at, 0], rgb[at, 1], rgb[at, 2] = (
            _byte(red * (looks[k, 0] * light)),
            _byte(green * (looks[k, 1] * light)),
            _byte(blue * (looks[k, 2] * light)),
        )
