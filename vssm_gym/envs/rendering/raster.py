"""Find the first box along every pixel's ray, by drawing the boxes' faces into a buffer of inverse depth.

    w(i, j) = 1 / z = (n . K^-1 [i, j, 1]) / (n . p)        on the plane of a face with normal n through p

is linear in the pixel, so a face costs one multiplication and one comparison a pixel, several times less than a ray.
Back faces are skipped, the others are clipped before the camera and cut to their convex outline. A pixel belongs to the
face that its centre's ray meets first, as if it were traced, except for rays that pass an outline closer than
:data:`_RIM`. Of faces that coincide the first box's is shown.
"""

from collections.abc import Sequence

import numba
import numpy as np

from vssm_gym.envs.scenes.solids import SolidBox

LEAST_DISTANCE = 1e-6  # m, least distance from the camera of a visible point
_RIM = 1e-5  # pixels by which a face is drawn larger, so that no ray slips between two that share an edge
_SAME = np.float32(1.0 + 2e-6)  # nearness of faces that coincide, but for rounding
SIDES = 6  # faces a box


def box_frames(boxes: Sequence[SolidBox]) -> np.ndarray:
    """Return ``(n, 8)`` float64: centre (m), half size (m), cosine and sine of yaw, as :func:`draw` reads them."""
    rows = [(*box.center, *(0.5 * extent for extent in box.size), np.cos(box.yaw), np.sin(box.yaw)) for box in boxes]
    return np.array(rows, dtype=np.float64).reshape(-1, 8)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def draw(T, frames, fx, fy, cx, cy, nearness, face):
    """Draw all boxes as the camera at ``T`` (4, 4) sees them.

    Args:
        T: camera to world, float64, C-contiguous.
        frames: :func:`box_frames`.
        fx, fy, cx, cy: intrinsics, pixels; pixel centres at integers.
        nearness: ``(H, W)`` float32, overwritten: ``1 / z`` (1/m) of the nearest face, 0 where there is none.
        face: ``(H, W)`` int32, overwritten: ``6 box + 2 axis + (1 on the positive side)``, -1 where there is none.
    """
    height, width = nearness.shape
    nearness[:] = np.float32(0.0)
    face[:] = np.int32(-1)
    # Outward normals of the view's four sides, in the camera frame (not of unit length: only signs matter).
    left, right = (-0.5 - cx - _RIM) / fx, (width - 0.5 - cx + _RIM) / fx
    upper, lower = (-0.5 - cy - _RIM) / fy, (height - 0.5 - cy + _RIM) / fy
    center, axes, spans = np.empty(3), np.empty((3, 3)), np.empty((3, 3))  # camera frame; spans: half the box an axis
    eye, corner = np.empty(3), np.empty((4, 3))
    clipped, edges = np.empty((8, 3)), np.empty((8, 3))
    for k in range(frames.shape[0]):
        dx, dy, dz = frames[k, 0] - T[0, 3], frames[k, 1] - T[1, 3], frames[k, 2] - T[2, 3]
        hx, hy, hz, c, s = frames[k, 3], frames[k, 4], frames[k, 5], frames[k, 6], frames[k, 7]
        for a in range(3):
            center[a] = T[0, a] * dx + T[1, a] * dy + T[2, a] * dz
            axes[0, a], axes[1, a], axes[2, a] = c * T[0, a] + s * T[1, a], c * T[1, a] - s * T[0, a], T[2, a]
            spans[0, a], spans[1, a], spans[2, a] = hx * axes[0, a], hy * axes[1, a], hz * axes[2, a]
        reach = abs(spans[0, 2]) + abs(spans[1, 2]) + abs(spans[2, 2])
        if center[2] + reach < LEAST_DISTANCE:
            continue
        if (
            _beyond(center, spans, 0, -1.0, left)
            or _beyond(center, spans, 0, 1.0, -right)
            or _beyond(center, spans, 1, -1.0, upper)
            or _beyond(center, spans, 1, 1.0, -lower)
        ):
            continue
        cut = center[2] - reach < LEAST_DISTANCE  # part of the box may be behind the camera
        eye[0], eye[1], eye[2] = -(c * dx + s * dy), s * dx - c * dy, -dz  # the camera in the box's frame
        inside = abs(eye[0]) <= hx and abs(eye[1]) <= hy and abs(eye[2]) <= hz
        for axis in range(3):
            half = frames[k, 3 + axis]
            across, along = (axis + 1) % 3, (axis + 2) % 3
            for positive in range(2):
                sign = 2.0 * positive - 1.0
                away = sign * eye[axis] - half  # distance of the camera from the face's plane, on its outer side
                if inside:
                    away = -away  # then the far sides are seen, from within
                if not away > 0.0:
                    continue
                for v in range(4):
                    p, q = (1.0 if v == 1 or v == 2 else -1.0), (1.0 if v >= 2 else -1.0)
                    for a in range(3):
                        corner[v, a] = center[a] + sign * spans[axis, a] + p * spans[across, a] + q * spans[along, a]
                corners = _clip(corner, clipped, cut)
                if corners < 3:
                    continue
                # The face's plane: n . x = d with n away from the camera, so that d = away > 0.
                flip = (1.0 if inside else -1.0) * sign
                n0, n1, n2 = flip * axes[axis, 0], flip * axes[axis, 1], flip * axes[axis, 2]
                wx, wy = n0 / (fx * away), n1 / (fy * away)
                w0 = n2 / away - wx * cx - wy * cy
                _fill(
                    clipped, corners, edges, fx, fy, cx, cy, wx, wy, w0,
                    nearness, face, np.int32(SIDES * k + 2 * axis + positive),
                )  # fmt: skip


@numba.njit(nogil=True, cache=True, inline="always")
def _beyond(center, spans, a, sign, bound):
    """Return True if the whole box has ``sign x_a + bound z > 0``: it lies outside one side of the view."""
    middle = sign * center[a] + bound * center[2]
    reach = 0.0
    for i in range(3):
        reach += abs(sign * spans[i, a] + bound * spans[i, 2])
    return middle - reach > 0.0


@numba.njit(nogil=True, cache=True)
def _clip(corner, clipped, cut):
    """Cut a quadrilateral to its part beyond the plane ``z = LEAST_DISTANCE``; return its number of corners."""
    if not cut:
        clipped[:4] = corner
        return 4
    n = 0
    for v in range(4):
        p, q = corner[v], corner[(v + 1) % 4]
        if p[2] >= LEAST_DISTANCE:
            clipped[n] = p
            n += 1
        if (p[2] >= LEAST_DISTANCE) != (q[2] >= LEAST_DISTANCE):
            share = (LEAST_DISTANCE - p[2]) / (q[2] - p[2])
            for a in range(3):
                clipped[n, a] = p[a] + share * (q[a] - p[a])
            clipped[n, 2] = LEAST_DISTANCE
            n += 1
    return n


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _fill(corners, n, edges, fx, fy, cx, cy, wx, wy, w0, nearness, face, index):
    """Draw one convex polygon (camera frame) of inverse depth ``w0 + wx i + wy j`` where it is nearest so far."""
    height, width = nearness.shape
    top, bottom, left, right = np.inf, -np.inf, np.inf, -np.inf
    turn = 0.0
    for v in range(n):
        p, q = corners[v], corners[(v + 1) % n]
        px, py = fx * p[0] / p[2] + cx, fy * p[1] / p[2] + cy
        qx, qy = fx * q[0] / q[2] + cx, fy * q[1] / q[2] + cy
        top, bottom, left, right = min(top, py), max(bottom, py), min(left, px), max(right, px)
        turn += px * qy - qx * py
        # The edge's line a i + b j + c = 0, of unit normal: distances from it in pixels.
        a, b = py - qy, qx - px
        length = np.sqrt(a * a + b * b)
        scale = 1.0 / length if length > 1e-12 else 0.0
        edges[v, 0], edges[v, 1] = a * scale, b * scale
        edges[v, 2] = -(a * px + b * py) * scale
    if not abs(turn) > 2.0 * _RIM * (bottom - top + right - left):
        return  # seen edge-on: thinner than the rim, and its nearness the difference of large numbers
    facing = 1.0 if turn > 0.0 else -1.0
    first, last = int(np.ceil(max(top - _RIM, 0.0))), int(np.floor(min(bottom + _RIM, height - 1.0)))
    for row in range(first, last + 1):
        low, high = max(-0.5, left - _RIM), min(width - 0.5, right + _RIM)
        for v in range(n):
            slope = facing * edges[v, 0]
            rest = facing * (edges[v, 1] * row + edges[v, 2]) + _RIM  # inside where slope i + rest >= 0
            if slope > 1e-12:
                low = max(low, -rest / slope)
            elif slope < -1e-12:
                high = min(high, -rest / slope)
            elif rest < 0.0:
                high = -1.0
        start, stop = int(np.ceil(low)), int(np.floor(high)) + 1
        if start < stop:
            # Counted from the first pixel, so that float32 carries the face's own nearness and no larger number.
            w = np.float32(w0 + wy * row + wx * start)
            _draw_run(w, np.float32(wx), nearness[row, start:stop], face[row, start:stop], index)


@numba.njit(nogil=True, cache=True)
def _draw_run(w, step, nearest, owner, index):
    """Draw the pixels of one row in which the face is nearest so far.

    It is a function of its own so that it vectorises.
    """
    for i in range(nearest.shape[0]):
        here = w + step * np.float32(i)
        old, at = nearest[i], owner[i]
        nearer = here > old * _SAME
        nearest[i] = here if nearer else old
        owner[i] = index if nearer else at
