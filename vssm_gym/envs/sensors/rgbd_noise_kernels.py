"""Apply the errors of :mod:`vssm_gym.envs.sensors.rgbd_noise`: one compiled loop over the pixels for each effect.

Images are ``(height, width)``; ``x`` and ``y`` are the tangents of the columns and rows; depth is z-depth in m, 0 where
there is none.
"""

import math

import numba
import numpy as np

EDGE_JUMP = 0.05  # an edge is where inverse depth leaves the straight line of a plane by this fraction of itself


@numba.njit(nogil=True, cache=True, error_model="numpy")
def inverse_depth(z):
    """Return ``1 / z``, and almost 0 where there is no depth, so that its border is an edge."""
    w = np.empty(z.shape)
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            w[i, j] = 1.0 / z[i, j] if z[i, j] > 0.0 else 1e-6
    return w


@numba.njit(nogil=True, cache=True, inline="always")
def _slope(before, after):
    return before if abs(before) < abs(after) else after


@numba.njit(nogil=True, cache=True, error_model="numpy")
def incidence(w, x, y, fx, fy):
    """Return the cosine between ray and normal of each pixel.

    In the image of a plane ``n . p = c`` inverse depth is ``n . (x, y, 1) / c``: its gradient gives the normal without
    error. Of the two one-sided slopes the smaller one crosses no edge.
    """
    height, width = w.shape
    cosine = np.empty((height, width))
    for i in range(height):
        for j in range(width):
            here, w_x, w_y = w[i, j], 0.0, 0.0
            if width > 1:
                left = here - w[i, j - 1] if j > 0 else w[i, j + 1] - here
                right = w[i, j + 1] - here if j + 1 < width else left
                w_x = fx * _slope(left, right)
            if height > 1:
                above = here - w[i - 1, j] if i > 0 else w[i + 1, j] - here
                below = w[i + 1, j] - here if i + 1 < height else above
                w_y = fy * _slope(above, below)
            along = here - x[j] * w_x - y[i] * w_y
            normal = math.sqrt(w_x * w_x + w_y * w_y + along * along)
            cosine[i, j] = here / (max(normal, 1e-12) * math.sqrt(1.0 + x[j] * x[j] + y[i] * y[i]))
    return cosine


@numba.njit(nogil=True, cache=True)
def edges(w):
    """Return the pixels on both sides of a jump.

    Along a plane, however slanted, inverse depth has no second difference.
    """
    height, width = w.shape
    edge = np.empty((height, width), dtype=np.bool_)
    for i in range(height):
        for j in range(width):
            bend = 0.0
            if 0 < j < width - 1:
                bend = abs(w[i, j + 1] - 2.0 * w[i, j] + w[i, j - 1])
            if 0 < i < height - 1:
                bend = max(bend, abs(w[i + 1, j] - 2.0 * w[i, j] + w[i - 1, j]))
            edge[i, j] = bend > EDGE_JUMP * w[i, j]
    return edge


@numba.njit(nogil=True, cache=True)
def shadow(w, x, baseline):
    """Return the pixels that the projector does not reach because a nearer surface occludes them.

    ``x - b / z`` is the projector's own coordinate of a point of the row, and it falls from left to right only where a
    nearer surface to the right covers what lies to the left.
    """
    height, width = w.shape
    covered = np.empty((height, width), dtype=np.bool_)
    for i in range(height):
        least = np.inf
        for j in range(width - 1, -1, -1):
            theirs = x[j] - baseline * w[i, j]
            covered[i, j] = theirs > least + 1e-9
            if w[i, j] > 1e-6:  # no surface covers nothing
                least = min(least, theirs)
    return covered


@numba.njit(nogil=True, cache=True, error_model="numpy")
def losses(z, w, cosine, rgb, x, y, edge, covered, chance, min_cosine, dropout, edge_share, min_signal):
    """Return the pixels without a reading.

    The effects are independent, so one ``chance`` in [0, 1) decides about all of them.
    """
    height, width = z.shape
    lost = np.empty((height, width), dtype=np.bool_)
    for i in range(height):
        for j in range(width):
            kept = 1.0 - dropout
            if edge[i, j]:
                kept *= 1.0 - edge_share
            if min_signal > 0.0:
                bright = (0.299 * rgb[i, j, 0] + 0.587 * rgb[i, j, 1] + 0.114 * rgb[i, j, 2]) / 255.0
                signal = bright * cosine[i, j] * w[i, j] * w[i, j] / (1.0 + x[j] * x[j] + y[i] * y[i])
                kept *= min(1.0, max(0.0, signal / min_signal - 0.5))
            lost[i, j] = z[i, j] <= 0.0 or covered[i, j] or cosine[i, j] < min_cosine or chance[i, j] >= kept
    return lost


@numba.njit(nogil=True, cache=True)
def smooth(white, taps):
    """Filter noise with the separable ``taps`` (odd number).

    Return the part that is ``len(taps) // 2`` off the border.
    """
    height, width = white.shape[0] - len(taps) + 1, white.shape[1] - len(taps) + 1
    across, both = np.zeros((white.shape[0], width), dtype=np.float32), np.zeros((height, width), dtype=np.float32)
    for i in range(white.shape[0]):
        for k in range(len(taps)):
            for j in range(width):
                across[i, j] += taps[k] * white[i, j + k]
    for i in range(height):
        for k in range(len(taps)):
            for j in range(width):
                both[i, j] += taps[k] * across[i + k, j]
    return both


@numba.njit(nogil=True, cache=True, inline="always")
def _acos(c):
    """Return the arc cosine of 0 to 1, to 7e-5 rad (Abramowitz and Stegun 4.4.45), faster than the library's."""
    return math.sqrt(1.0 - c) * (1.5707288 + c * (-0.2121144 + c * (0.0742610 - c * 0.0187293)))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def measure(z, cosine, lost, shift, normal, floor, growth, start, grazing, step_1m, min_depth, max_depth):
    """Return measured depth, float32: read ``shift`` pixels aside, noisy, in steps of ``step_1m z^2``, within range."""
    height, width = z.shape
    seen = np.zeros((height, width), dtype=np.float32)
    for i in range(height):
        for j in range(width):
            row, column = i, j
            if len(shift):
                row = min(max(i + shift[0, i, j], 0), height - 1)
                column = min(max(j + shift[1, i, j], 0), width - 1)
            if lost[row, column]:
                continue
            true = float(z[row, column])
            std = floor + growth * max(true - start, 0.0) ** 2
            if grazing > 0.0:
                angle = _acos(min(max(cosine[row, column], 1e-3), 1.0))
                std += grazing / math.sqrt(max(true, 0.1)) * (angle / (0.5 * math.pi - angle)) ** 2
            if step_1m > 0.0:
                # Rounding adds a uniform error of one step; the Gaussian supplies the rest of the variance std^2.
                step = step_1m * true * true
                std = math.sqrt(max(std * std - step * step / 12.0, 0.0))
            read = true + std * normal[i, j] if std > 0.0 else true
            if read <= 0.0:
                continue
            if step_1m > 0.0:
                read = 1.0 / (step_1m * max(np.rint(1.0 / (step_1m * read)), 1.0))
            if min_depth <= read <= max_depth:
                seen[i, j] = read
    return seen


@numba.njit(nogil=True, cache=True)
def colour(rgb, light, std, normal):
    """Return ``light[v] + std[v] n`` of each byte v, rounded and clipped to a byte."""
    seen = np.empty(rgb.shape, dtype=np.uint8)
    for i in range(rgb.shape[0]):
        for j in range(rgb.shape[1]):
            for k in range(3):
                v = rgb[i, j, k]
                value = light[v] + std[v] * normal[i, j, k]
                seen[i, j, k] = np.uint8(np.rint(min(max(value, 0.0), 255.0)))
    return seen
