"""Plan a short route that shows a camera all of an apartment: viewpoints that cover its free space, joined into a tour.

Viewpoints are a greedy set cover: every free position (on a 0.2 m grid) has one within ``reach`` and in line of sight
(past obstacles at the robot's height; the camera looks over the low ones). They and the paths between them keep the
largest clearance with which all rooms stay connected; only what cannot be seen from there is visited more closely, with
the clearance that the narrowest passage allows. The tour is nearest neighbour plus 2-opt over geodesic distances. It
knows the true floor plan: it drives the recording of a map (``vssm-gym record``), never an agent.
"""

import itertools
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.scenes.free_space import ROOM_AREA, FreeSpace
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.errors import InputError

SURVEY_GRID = 0.2  # m between positions that must be seen, and between candidate viewpoints
CLEARANCES = (0.2, 0.15, 0.1, 0.05)  # m between the robot's side and obstacles, tried in this order
# m of clearance where nothing wider sees a place: the first with which free space stays in one part
CLOSE = (0.03, 0.015, 0.005, 0.001)
STRAIGHTEN_SHARE = 2.0 / 3.0  # of the clearance: by how much a leg may cut the chords of a rounded corner


@dataclass(frozen=True)
class Waypoint:
    """Hold a position to drive to in a straight line from the one before, world frame, metres."""

    x: float
    y: float
    turn_around: bool  # a viewpoint: look once in every direction


def survey_route(apartment: Apartment, robot: Robot, seed: int = 0, reach: float = 1.2) -> list[Waypoint]:
    """Return the waypoints of a survey of all that the robot can reach; the recording starts at the first one.

    Args:
        apartment: the scene; rooms that are cut off are left out (``FreeSpace.cut_off_rooms`` names them).
        robot: its footprint decides where it can go.
        seed: shifts the grid of viewpoints, so that recordings of different seeds differ.
        reach: metres within which each free position has a viewpoint that sees it.

    Raises:
        InputError: no room for the robot.
    """
    space = FreeSpace.from_apartment(apartment, robot.radius, robot.height)
    margin, close = _close(space)
    wide = _clear(space, close)
    targets = _grid(space.largest, np.zeros(2))
    offset = np.random.default_rng(seed).uniform(0.0, SURVEY_GRID, 2)
    roomy, tight = _grid(wide.largest, offset), _grid(close.largest, offset)
    candidates = np.concatenate([roomy, tight])
    sees = _sees(space.widened(-space.radius).region, candidates, targets, reach)
    first = np.arange(len(candidates)) < len(roomy)
    chosen, seen = _cover(sees, first, np.zeros(len(targets), dtype=bool))
    more, _ = _cover(sees, ~first, seen)
    chosen = _without_needless(sees, [*chosen, *more])
    for name, room in space.rooms.items():
        inside = np.flatnonzero(shapely.contains_xy(room, candidates))
        if name not in space.cut_off_rooms() and len(inside) and not np.isin(chosen, inside).any():
            chosen.append(int(inside[np.argmax(space.distance_to_obstacle(candidates[inside]))]))
    places, is_roomy = candidates[chosen], np.array(chosen) < len(roomy)
    return _route(places, is_roomy, Geodesics(wide), Geodesics(close), STRAIGHTEN_SHARE * margin)


def _clear(space: FreeSpace, close: FreeSpace) -> FreeSpace:
    """Return the free space of the largest clearance with which no more rooms are cut off.

    ``close`` where there is none.
    """
    for margin in CLEARANCES:
        wide = _within(space, margin)
        if wide is not space and set(wide.cut_off_rooms()) <= set(space.cut_off_rooms()):
            return wide
    return close


def _close(space: FreeSpace) -> tuple[float, FreeSpace]:
    """Return the largest clearance of CLOSE, m, with which ``space.largest`` stays connected, and its space.

    Small remaining areas do not count. A passage that leaves less room beside the robot would be closed: what is beyond
    would never be seen.
    """
    for margin in CLOSE:
        near = _within(space, margin)
        parts = [part.area for part in near.region.geoms if space.largest.intersects(part)]
        if near is not space and sum(parts) - near.largest.area <= ROOM_AREA:
            return margin, near
    return 0.0, space


def _within(space: FreeSpace, margin: float) -> FreeSpace:
    """Return ``space`` with that much more clearance, or itself where nothing would be left in its largest part."""
    try:
        wide = space.widened(margin)
    except InputError:
        return space
    return wide if space.largest.intersects(wide.largest) else space


def _grid(area: shapely.Polygon, offset: Float[np.ndarray, "2"]) -> Float[np.ndarray, "n 2"]:
    """Return grid points in ``area``, or one point of it where the grid has none."""
    low, high = np.split(np.array(area.bounds), 2)
    x, y = (np.arange(a + o, b, SURVEY_GRID) for a, o, b in zip(low, offset, high, strict=True))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = points[shapely.contains_xy(area, points)]
    return inside if len(inside) else np.array([area.representative_point().coords[0]])


def _sees(
    open_floor: shapely.MultiPolygon,
    viewpoints: Float[np.ndarray, "k 2"],
    targets: Float[np.ndarray, "n 2"],
    reach: float,
) -> Bool[np.ndarray, "k n"]:
    """Return True where a target is within ``reach`` of a viewpoint, with nothing standing between them."""
    near = cKDTree(viewpoints).sparse_distance_matrix(cKDTree(targets), reach, output_type="coo_matrix")
    lines = shapely.linestrings(np.stack([viewpoints[near.row], targets[near.col]], axis=1))
    sees = np.zeros((len(viewpoints), len(targets)), dtype=bool)
    sees[near.row, near.col] = shapely.covers(open_floor, lines)
    return sees


def _cover(
    sees: Bool[np.ndarray, "k n"], allowed: Bool[np.ndarray, "k"], seen: Bool[np.ndarray, "n"]
) -> tuple[list[int], Bool[np.ndarray, "n"]]:
    """Cover the targets greedily: add the viewpoint that shows most unseen ones, until none shows anything new."""
    chosen: list[int] = []
    seen = seen.copy()
    while True:
        gain = np.where(allowed, (sees & ~seen).sum(axis=1), 0)
        best = int(np.argmax(gain))
        if gain[best] == 0:
            return chosen, seen
        chosen.append(best)
        seen |= sees[best]


def _without_needless(sees: Bool[np.ndarray, "k n"], chosen: list[int]) -> list[int]:
    """Return ``chosen`` without the viewpoints that later choices made needless, the tight and late ones first."""
    shown = sees[chosen].sum(axis=0)
    kept = []
    for viewpoint in reversed(chosen):
        if np.all(shown[sees[viewpoint]] > 1):
            shown = shown - sees[viewpoint]
        else:
            kept.append(viewpoint)
    return kept


def _route(
    points: Float[np.ndarray, "n 2"], roomy: Bool[np.ndarray, "n"], wide: Geodesics, close: Geodesics, cut: float
) -> list[Waypoint]:
    """Build the tour through all viewpoints: paths between roomy ones in the wide space, all others in the close one.

    Legs may cut corners by ``cut`` m, less than both spaces keep from obstacles.
    """
    lengths = close.matrix(points)
    pairs = np.ix_(roomy, roomy)
    lengths[pairs] = wide.matrix(points[roomy])
    order = short_tour(lengths)
    route = [_waypoint(points[order[0]], turn_around=True)]
    for a, b in itertools.pairwise(order):
        path = (wide if roomy[a] and roomy[b] else close).path(points[a], points[b])
        corners = shapely.get_coordinates(shapely.LineString(path).simplify(cut))
        route += [_waypoint(corner, turn_around=False) for corner in corners[1:-1]]
        route.append(_waypoint(points[b], turn_around=True))
    return route


def _waypoint(xy: Float[np.ndarray, "2"], turn_around: bool) -> Waypoint:
    return Waypoint(float(xy[0]), float(xy[1]), turn_around)


def short_tour(lengths: Float[np.ndarray, "n n"]) -> Int[np.ndarray, "n"]:
    """Order n places to be visited once, from a free start to a free end: nearest neighbour, then 2-opt.

    Args:
        lengths: symmetric distances; all finite.
    """
    tours = [_two_opt(_nearest_neighbours(lengths, start), lengths) for start in range(len(lengths))]
    return min(tours, key=lambda tour: float(lengths[tour[:-1], tour[1:]].sum()))


def _nearest_neighbours(lengths: Float[np.ndarray, "n n"], start: int) -> Int[np.ndarray, "n"]:
    tour = [start]
    left = np.ones(len(lengths), dtype=bool)
    left[start] = False
    while left.any():
        tour.append(int(np.argmin(np.where(left, lengths[tour[-1]], np.inf))))
        left[tour[-1]] = False
    return np.array(tour)


def _two_opt(tour: Int[np.ndarray, "n"], lengths: Float[np.ndarray, "n n"]) -> Int[np.ndarray, "n"]:
    """Reverse the stretch i..j of the tour that saves most, until none does; the ends of an open tour are free."""
    n = len(tour)
    i, j = np.triu_indices(n, 1)
    while True:
        # Place n stands for "nothing": it is at distance 0 before the start and after the end.
        padded = np.zeros((n + 1, n + 1))
        padded[:n, :n] = lengths
        around = np.concatenate([[n], tour, [n]])
        before, first, last, after = around[i], around[i + 1], around[j + 1], around[j + 2]
        change = padded[before, last] + padded[first, after] - padded[before, first] - padded[last, after]
        best = int(np.argmin(change)) if n > 1 else 0
        if n < 2 or change[best] > -1e-9:
            return tour
        tour = tour.copy()
        tour[i[best] : j[best] + 1] = tour[i[best] : j[best] + 1][::-1]
