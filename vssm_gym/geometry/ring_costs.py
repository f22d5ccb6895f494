"""Sum robust residuals of an image against panoramas at all headings: the inner loop of relocalisation.

Sums along headings are vectorised by the compiler: what a column of the image meets at every heading is one slice of a
panorama that is stored twice in a row.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def accumulate(
    log_range: np.ndarray,
    log_colour: np.ndarray,
    read: np.ndarray,
    seen: np.ndarray,
    weights: np.ndarray,
    starts: np.ndarray,
    map_range: np.ndarray,
    map_colour: np.ndarray,
    map_known: np.ndarray,
    scales: np.ndarray,
    cost: np.ndarray,
) -> None:
    """Add the costs of all cells of an image to ``cost`` (eq. I43).

    Args:
        log_range: ``(rows, columns)`` of the image.
        log_colour: ``(3, rows, columns)``.
        read: ``(rows, columns)``, 1 where the image has a distance.
        seen: ``(rows, columns)``, 1 where it has a colour.
        weights: ``(rows, columns)``, inverse scales of the logarithms of distances; 0 without one.
        starts: ``(columns,)`` column of the panorama that each column meets at heading 0.
        map_range: ``(rows, places, 2 headings)`` of the panoramas, each stored twice in a row.
        map_colour: ``(3, rows, places, 2 headings)``.
        map_known: ``(rows, places, 2 headings)``, 1 where a surface was observed.
        scales: inverse scale of colours, limit of a residual, price of what one of the two does not show, largest gain.
        cost: ``(places, headings)``, float32.
    """
    rows, columns = log_range.shape
    places, headings = cost.shape
    inverse, limit, unseen, most = scales
    one, third = np.float32(1.0), np.float32(1.0 / 3.0)
    gain, both = np.empty(headings, np.float32), np.empty(headings, np.float32)
    for p in range(places):
        gain[:], both[:] = np.float32(0.0), np.float32(1e-3)
        for i in range(columns):
            a, b = starts[i], starts[i] + headings
            for r in range(rows):
                if seen[r, i] == 0.0:
                    continue
                mean = (log_colour[0, r, i] + log_colour[1, r, i] + log_colour[2, r, i]) * third
                known = map_known[r, p, a:b]
                red, green, blue = map_colour[0, r, p, a:b], map_colour[1, r, p, a:b], map_colour[2, r, p, a:b]
                for h in range(headings):
                    gain[h] += known[h] * ((red[h] + green[h] + blue[h]) * third - mean)
                    both[h] += known[h]
        for h in range(headings):
            gain[h] = min(max(gain[h] / both[h], -most), most)
        out = cost[p]
        for i in range(columns):
            a, b = starts[i], starts[i] + headings
            for r in range(rows):
                if seen[r, i] == 0.0:
                    continue
                x, w = log_range[r, i], weights[r, i]
                c0, c1, c2 = log_colour[0, r, i], log_colour[1, r, i], log_colour[2, r, i]
                alone = unseen * (one + read[r, i])
                known, far = map_known[r, p, a:b], map_range[r, p, a:b]
                red, green, blue = map_colour[0, r, p, a:b], map_colour[1, r, p, a:b], map_colour[2, r, p, a:b]
                for h in range(headings):
                    g = gain[h]
                    off = min(abs(red[h] - g - c0) * inverse, limit)
                    off += min(abs(green[h] - g - c1) * inverse, limit)
                    off += min(abs(blue[h] - g - c2) * inverse, limit)
                    total = off * third + min(abs(far[h] - x) * w, limit)
                    out[h] += known[h] * total + (one - known[h]) * alone
