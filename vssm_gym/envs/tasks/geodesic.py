"""Compute shortest any-angle paths of the robot's centre through its free space, by a visibility graph.

In a polygon a shortest path is a chain of straight segments that bends only at reflex vertices. Each segment is
*tangent* there: both neighbours of the vertex lie on one side of the segment's line (de Berg et al., Computational
Geometry, ch. 15). All pairs of reflex vertices with a free segment that is tangent at both ends form a graph, which is
computed once; a query links its two points to it and runs Dijkstra's algorithm. The result is exact for the polygon, so
within 1 mm of the disc's own free space at every corner. It shares no code with the agents' planner, so that SPL is
evaluated independently of A*.

The graph grows with the square of the vertices. Free space with more than EXACT_CORNERS of them (a large, noisy
occupancy map) is first drawn in and straightened by at most the last of STRAIGHTEN: paths stay free, but are up to a
few per cent longer than the shortest, and gaps narrower than twice that much are closed.
"""

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from vssm_gym.envs.scenes.free_space import FreeSpace

EXACT_CORNERS = 3000  # of free space that is taken as it is
STRAIGHTEN = (0.01, 0.02, 0.04, 0.07, 0.1)  # m, tried in this order
_SIDE = 1e-9  # m^2; tolerance of the tangent test, which only removes edges: one too many never makes a path shorter
_NUDGE = 1e-6  # rad; end points of free arcs of the goal's circle move this far inside free space
_SEGMENTS_AT_ONCE = 64  # candidate last segments tested for visibility at a time
_NO_PATH = (np.inf, np.zeros((0, 2)))  # length (m) and positions


class Geodesics:
    """Compute shortest paths in a :class:`FreeSpace`; building takes about a second, a query some milliseconds."""

    def __init__(self, free_space: FreeSpace) -> None:
        self._space = free_space
        self._region = _straightened(free_space.region)
        shapely.prepare(self._region)
        oriented = shapely.orient_polygons(shapely.get_parts(self._region))  # free space lies to the left of every ring
        rings = [shapely.get_coordinates(ring)[:-1] for ring in shapely.get_rings(oriented)]
        point = np.concatenate(rings)
        before = np.concatenate([np.roll(ring, 1, axis=0) for ring in rings])
        after = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
        self._border = point, after  # (e, 2) start and end of every border segment
        reflex = _cross(point - before, after - point) < 0.0
        self._vertex, self._before, self._after = point[reflex], before[reflex], after[reflex]
        self._graph = self._visibility_graph()

    def length(self, start: Float[np.ndarray, "2"], goal: Float[np.ndarray, "2"], goal_radius: float = 0.0) -> float:
        """``min |path|`` from ``start`` to ``{p free: |p - goal| <= goal_radius}``, metres; inf where there is none.

        A free point of the disc counts even where a wall separates it from the goal, as it does for success.
        """
        return self._shortest(start, goal, goal_radius)[0]

    def path(
        self, start: Float[np.ndarray, "2"], goal: Float[np.ndarray, "2"], goal_radius: float = 0.0
    ) -> Float[np.ndarray, "n 2"]:
        """Return the corners of the path that :meth:`length` measures, start and end included, metres.

        ``(0, 2)`` if none.
        """
        return self._shortest(start, goal, goal_radius)[1]

    def matrix(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n n"]:
        """Return the shortest path lengths between all pairs of ``points``, metres; inf where there is none."""
        points = np.asarray(points, dtype=np.float64)
        n, size = len(points), len(self._vertex)
        i, j = np.triu_indices(n, 1)
        direct = self._visible(points[i], points[j])
        source, vertex = self._links(points)
        rows = np.concatenate([size + source, size + i[direct]])
        columns = np.concatenate([vertex, size + j[direct]])
        links = _symmetric_graph(np.concatenate([self._vertex, points]), rows, columns)
        inner = self._graph.tocoo()
        graph = csr_array((inner.data, inner.coords), shape=links.shape) + links
        lengths = dijkstra(graph, indices=np.arange(size, size + n))[:, size:]
        np.fill_diagonal(lengths, np.where(shapely.intersects_xy(self._region, points), 0.0, np.inf))
        return lengths

    def _shortest(
        self, start: Float[np.ndarray, "2"], goal: Float[np.ndarray, "2"], radius: float
    ) -> tuple[float, Float[np.ndarray, "n 2"]]:
        """Return length and corners of the shortest path into the goal's disc."""
        start, goal = np.asarray(start, dtype=np.float64), np.asarray(goal, dtype=np.float64)
        if not shapely.intersects_xy(self._region, *start):
            entry = self._entry(start)
            if entry is None:
                return _NO_PATH
            length, path = self._shortest(entry, goal, radius)
            return length + float(np.linalg.norm(entry - start)), np.concatenate([start[None], path])
        if np.linalg.norm(start - goal) <= radius:
            return 0.0, start[None]
        to_vertex, previous = self._from(start)
        # Node -1, last in these arrays, is the start itself.
        node = np.append(np.flatnonzero(np.isfinite(to_vertex)), -1)
        leave = np.concatenate([self._vertex[node[:-1]], start[None]])
        so_far = np.append(to_vertex[node[:-1]], 0.0)
        # The last segment ends on the disc's circle: perpendicular to it, or at the end of one of its free arcs.
        offset = leave - goal
        away = np.linalg.norm(offset, axis=1)
        foot = goal + offset * np.minimum(1.0, radius / np.maximum(away, 1e-12))[:, None]
        ends = [foot, *(np.broadcast_to(corner, foot.shape) for corner in self._free_arc_ends(goal, radius))]
        end = np.stack(ends, axis=1)
        total = so_far[:, None] + np.linalg.norm(end - leave[:, None], axis=2)
        # A path that reaches a vertex inside the disc has crossed the circle before: never needed.
        possible = np.ones(total.shape, dtype=bool)
        possible[:-1] = (away[:-1] > radius)[:, None] & self._tangent(end[:-1], node[:-1, None])
        rows, columns = np.nonzero(possible)
        order = np.argsort(total[rows, columns], kind="stable")
        for first in range(0, len(order), _SEGMENTS_AT_ONCE):
            row, column = (index[order[first : first + _SEGMENTS_AT_ONCE]] for index in (rows, columns))
            visible = self._visible(leave[row], end[row, column])
            if visible.any():
                row, column = row[np.argmax(visible)], column[np.argmax(visible)]
                corners = [end[row, column]]
                at = node[row]
                while at >= 0:
                    corners.append(self._vertex[at])
                    at = previous[at]
                return float(total[row, column]), np.array([start, *corners[::-1]])
        return _NO_PATH

    def _entry(self, start: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"] | None:
        """Return where a free position outside the straightened region enters it; None where ``start`` is not free."""
        if self._region is self._space.region or not self._space.contains(start):
            return None
        inside = shapely.get_coordinates(shapely.shortest_line(shapely.points(start), self._region))[1]
        near = self._region.intersection(shapely.Point(inside).buffer(1e-6))
        return shapely.get_coordinates(near.representative_point())[0] if near.area > 0.0 else None

    def _from(self, start: Float[np.ndarray, "2"]) -> tuple[Float[np.ndarray, "v"], Int[np.ndarray, "v"]]:
        """Return the distances from ``start`` to every reflex vertex, and the vertex before each (-1: the start)."""
        graph, size = self._graph, len(self._vertex)
        _, vertex = self._links(start[None])
        weights = np.maximum(np.linalg.norm(self._vertex[vertex] - start, axis=1), 1e-12)  # 0 would mean no edge
        extended = csr_array(  # the start is one more row of the graph; nothing leads back to it
            (
                np.concatenate([graph.data, weights]),
                np.concatenate([graph.indices, vertex.astype(graph.indices.dtype)]),
                np.append(graph.indptr, graph.nnz + len(vertex)).astype(graph.indptr.dtype),
            ),
            shape=(size + 1, size + 1),
        )
        distance, previous = dijkstra(extended, indices=size, return_predecessors=True)
        return distance[:size], np.where(previous[:size] == size, -1, previous[:size])

    def _visibility_graph(self) -> csr_array:
        """Build the symmetric graph of the reflex vertices whose free segments are tangent at both ends.

        Metres.
        """
        size = len(self._vertex)
        tangent = np.zeros((size, size), dtype=bool)
        for first in range(0, size, 256):  # in blocks, to bound the memory
            some = slice(first, first + 256)
            tangent[some] = self._tangent(self._vertex[some, None], np.arange(size)[None])
        rows, columns = np.nonzero(np.triu(tangent & tangent.T, 1))
        visible = self._visible(self._vertex[rows], self._vertex[columns])
        return _symmetric_graph(self._vertex, rows[visible], columns[visible])

    def _links(self, points: Float[np.ndarray, "n 2"]) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"]]:
        """Return index pairs (point, vertex) whose segment is free and tangent at the vertex."""
        source, vertex = np.nonzero(self._tangent(points[:, None], np.arange(len(self._vertex))[None]))
        visible = self._visible(points[source], self._vertex[vertex])
        return source[visible], vertex[visible]

    def _tangent(self, source: Float[np.ndarray, "*n 2"], vertex: Int[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
        """Return True where a path from ``source`` may bend at ``vertex`` and still be locally shortest."""
        along = self._vertex[vertex] - source
        one = _cross(along, self._before[vertex] - self._vertex[vertex])
        other = _cross(along, self._after[vertex] - self._vertex[vertex])
        return ((one >= -_SIDE) & (other >= -_SIDE)) | ((one <= _SIDE) & (other <= _SIDE))

    def _visible(self, start: Float[np.ndarray, "n 2"], end: Float[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n"]:
        """Return True where whole segments are free; contact with the border is allowed.

        GEOS decides it without rounding.
        """
        return np.asarray(shapely.covers(self._region, shapely.linestrings(np.stack([start, end], axis=1))))

    def _free_arc_ends(self, goal: Float[np.ndarray, "2"], radius: float) -> Float[np.ndarray, "m 2"]:
        """Return the end points of the free arcs of the circle around ``goal``, just inside.

        ``(0, 2)`` if it is cut nowhere.
        """
        # |a + t b - goal|^2 = radius^2 along every border segment a + t b, t in [0, 1]
        a, b = self._border[0] - goal, self._border[1] - self._border[0]
        bb, ab = np.sum(b * b, axis=1), np.sum(a * b, axis=1)
        discriminant = ab**2 - bb * (np.sum(a * a, axis=1) - radius**2)
        root = np.sqrt(np.maximum(discriminant, 0.0))
        t = np.stack([-ab - root, -ab + root]) / bb
        cut = a + t[..., None] * b
        cut = cut[(discriminant > 0.0) & (t >= 0.0) & (t <= 1.0)]
        if radius == 0.0 or len(cut) == 0:
            return np.zeros((0, 2))
        low = np.sort(np.arctan2(cut[:, 1], cut[:, 0]))
        high = np.append(low[1:], low[0] + 2.0 * np.pi)
        free = shapely.intersects_xy(self._region, goal + radius * _direction(0.5 * (low + high)))
        free &= high - low > 4.0 * _NUDGE
        return goal + radius * _direction(np.concatenate([low[free] + _NUDGE, high[free] - _NUDGE]))


def _straightened(region: shapely.MultiPolygon) -> shapely.MultiPolygon:
    """Return ``region`` itself, or a part of it that has few enough corners."""
    result = region
    for distance in STRAIGHTEN:
        if shapely.get_num_coordinates(result) <= EXACT_CORNERS:
            break
        inner = region.buffer(-distance, join_style="mitre").simplify(0.95 * distance)
        result = shapely.MultiPolygon([part for part in shapely.get_parts(inner) if part.area > 1e-4])
    return result


def _cross(a: Float[np.ndarray, "*n 2"], b: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _direction(angle: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n 2"]:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _symmetric_graph(
    nodes: Float[np.ndarray, "n 2"], rows: Int[np.ndarray, "k"], columns: Int[np.ndarray, "k"]
) -> csr_array:
    """Build a sparse ``(n, n)`` graph with an edge both ways for each pair, weighted by distance (never 0: no edge)."""
    weights = np.maximum(np.linalg.norm(nodes[rows] - nodes[columns], axis=1), 1e-12)
    both = (np.concatenate([rows, columns]), np.concatenate([columns, rows]))
    return csr_array(coo_array((np.concatenate([weights, weights]), both), shape=(len(nodes), len(nodes))))
