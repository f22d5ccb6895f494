"""Explore where imagined images are most informative about the map, in the order of a minimum-latency tour (eq. P33).

    I(M; x | z) = sum_cells 1/2 log(1 + n lambda_u / lambda)     gain of views z together; n counts shared views
    order = argmin sum_legs |leg| (gain not yet made)            ``mode`` "coverage": a minimum-latency tour (eq. P42)
    goal = argmax gain / d,  or  gain - price d                  ``mode`` "rate", "difference": greedy, as published

At every choice ``mi_explorer`` first computes the gain of views in other directions from where it stands: they cost
time and no path length. Otherwise it takes up to ``places`` candidates that see different parts of the unknown,
imagines a full turn at each, and goes to the first of the best order. Described in ``docs/agents/exploration.md``.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from vssm_gym.agents.shared.explorer import Explorer
from vssm_gym.agents.shared.strategy import Choice, Situation
from vssm_gym.errors import InputError
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix, wrap_angle
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.planning.exploration.building_prior import expected_surfaces, over_map
from vssm_gym.planning.exploration.candidates import Roadmap, candidates, representatives
from vssm_gym.planning.exploration.information import Gain, InformationConfig, gain_of_paths
from vssm_gym.planning.exploration.minimum_latency_tour import MOST_PLACES, best_order
from vssm_gym.planning.floor_plan import CAMERA_REACH

Gains: TypeAlias = Callable[[np.ndarray, np.ndarray], Gain]  # of (poses, paths through them)


@dataclass(frozen=True)
class MiExplorerConfig:
    """Configure the candidates, the weights of gains, and the least gains that count."""

    mode: Literal["coverage", "rate", "difference"] = "coverage"
    price: float = 5000.0  # nats per metre of path, of the mode "difference"
    spacing: float = 0.5  # m between candidates
    same_place: float = 0.2  # m; a place so near to one that was visited counts as visited: it sees the same
    turn_views: int = 4  # views of a full turn at a candidate, evenly apart
    hazard: tuple[float, float] = (0.25, 3.0)  # 1/m, of surfaces in unknown space: in the building's outline, beyond
    least_share: float = 0.1  # fraction of the greatest gain, below which a place is left for later
    least_area: float = 0.05  # m^2 of unknown space that a candidate sees
    places: int = 10  # candidates whose views are imagined, at most
    decay: float = 0.2  # 1/m, discount of the area by distance when these are selected
    least_gain: float = 1000.0  # nats, least gain of a place that is visited
    headings: int = 8  # of the views from where the robot stands
    least_look: float = 600.0  # nats, least gain of such a view less the turn's price
    look_share: float = 0.003  # the same on the path to a goal, as a fraction of the whole tour's gain
    turn_price: float = 600.0  # nats per radian, for the time of a turn: a small part of what driving gains in it
    pose_weight: float = 1000.0  # nats of the map per nat of the own pose: a wrong pose spoils the map
    repeat: tuple[float, float] = (0.3, 0.5)  # m and rad; a view so close to one that was taken is not taken again
    strip: float = 1.0 / 3.0  # fraction of the image's rows, around the horizon: see `_strip`
    # A cell that was observed is known to 3 cm. Without ``known`` the gains of many known cells would outweigh a small
    # unseen place.
    information: InformationConfig = field(
        default_factory=lambda: InformationConfig(max_depth=CAMERA_REACH, known=OBSERVED_PRECISION, ground=0.0)
    )

    def __post_init__(self) -> None:
        if self.mode not in ("coverage", "rate", "difference"):
            raise InputError("MiExplorerConfig", "mode", f"coverage, rate or difference; found {self.mode!r}")
        if not (len(self.hazard) == 2 and min(self.hazard) >= 0.0):
            raise InputError("MiExplorerConfig", "hazard", f"two rates, at least 0 1/m; found {self.hazard!r}")
        if not 1 <= self.places <= MOST_PLACES:
            raise InputError("MiExplorerConfig", "places", f"1 to {MOST_PLACES}; found {self.places!r}")


@dataclass(frozen=True)
class Tour:
    """Hold the gains from which a viewpoint was chosen.

    Attributes:
        xy: ``(n, 2)`` places, m.
        nats: ``(n,)`` gain of each place after those before it, less ``least_gain``, less the information about the
            pose by which its views fall short of the best place's.
        first: number of the place that was chosen.
    """

    xy: np.ndarray
    nats: np.ndarray
    first: int


class MutualInformation:
    """Choose viewpoints by expected information; see the module."""

    def __init__(self, config: MiExplorerConfig) -> None:
        self._config = config

    def reset(self, seed: int) -> None:
        """Open an episode; nothing here is random, so ``seed`` changes nothing."""
        self.tour: Tour | None = None  # of the last choice of a place
        self._left = 0.0  # nats of the last tour
        self._viewed: list[tuple[float, float, float]] = []  # poses (m, rad) of the views taken so far
        self._goal: np.ndarray | None = None
        self._visited: list[np.ndarray] = []  # goals that were reached, m

    def choose(self, situation: Situation) -> Choice | None:
        """Return a view from here, or the first place of a tour."""
        if (
            situation.arrived
            and self._goal is not None
            and math.hypot(*(self._goal - situation.planar[:2])) < self._config.same_place
        ):
            self._visited.append(self._goal)
            self._goal = None
        c, plan = self._config, situation.roadmap.plan
        strip, hazard = _strip(situation.camera, c.strip), expected_surfaces(plan, *c.hazard)
        columns = over_map(plan, hazard, c.hazard[1], situation.map)

        def gain(planar: np.ndarray, paths: np.ndarray) -> Gain:
            views = planar_to_matrix(planar) @ situation.T_body_cam
            return gain_of_paths(situation.map, views, paths, strip, c.information, situation.std, columns)

        return self._look(situation, gain) or self._tour(situation, hazard, gain)

    def _look(self, situation: Situation, gain: Gains) -> Choice | None:
        """Return the view from here with the greatest gain less the turn's price, where that is enough."""
        c, (x, y, heading) = self._config, situation.planar
        within, apart = c.repeat
        made = [h for a, b, h in self._viewed if math.hypot(a - x, b - y) < within]
        turns = np.arange(c.headings) * 2.0 * math.pi / c.headings
        fresh = np.array([t for t in turns if all(abs(wrap_angle(float(t - h))) > apart for h in made)])
        if len(fresh) == 0:
            return None
        planar = np.stack([np.full(len(fresh), x), np.full(len(fresh), y), fresh], axis=1)
        found = gain(np.concatenate([planar, situation.planar[None]]), np.arange(len(fresh))[:, None])
        nats = found.total + c.pose_weight * (found.pose[:-1] - found.pose[-1])  # in addition to the present view
        value = nats - c.turn_price * np.abs(wrap_angle(fresh - heading))
        k = int(np.argmax(value))
        # On the path only views with enough gain for a stop; at a goal, all views.
        on_the_path = 0.0 if self._is_visited(situation.planar[:2]) else c.look_share * self._left
        if value[k] < max(c.least_look, on_the_path):
            return None
        self._viewed.append((x, y, float(fresh[k])))
        return Choice(None, (float(fresh[k]),), None, f"turns to a view of {nats[k]:.0f} nats")

    def _tour(self, situation: Situation, hazard: np.ndarray, gain: Gains) -> Choice | None:
        """Return where to go first; None where no place has the least gain."""
        c, roadmap = self._config, situation.roadmap
        found = candidates(
            roadmap, spacing=c.spacing, hazard=hazard, least_area=c.least_area, dismissed=situation.dismissed
        )
        fresh = np.array([not self._is_visited(place) for place in found.xy], bool)
        found = replace(found, xy=found.xy[fresh], distance=found.distance[fresh], seen=found.seen[fresh])
        chosen = representatives(found, c.places, c.decay, c.least_area)
        if len(chosen) == 0:
            return None
        xy, away = found.xy[chosen], found.distance[chosen]
        views = c.turn_views
        turns = np.arange(views) * 2.0 * math.pi / views
        planar = np.column_stack([np.repeat(xy, views, axis=0), np.tile(turns, len(xy))])
        # One trajectory through all of them gives what a place adds to those before it.
        looked = gain(planar, np.arange(len(planar))[None])
        held = looked.pose.reshape(-1, views).mean(axis=1)
        worth = np.diff(looked.along[0, views - 1 :: views], prepend=0.0) - c.least_gain
        worth += c.pose_weight * (held - held.max())  # less where the views have little information about the pose
        kept = np.flatnonzero(worth > max(0.0, c.least_share * float(worth.max(initial=0.0))))
        if len(kept) == 0:
            return None
        xy, away, worth = xy[kept], away[kept], worth[kept]
        self._left = float(worth.sum())
        first = self._first(roadmap, xy, away, worth)
        status = f"to {worth[first]:.0f} of {self._left:.0f} nats in {len(xy)} places, {away[first]:.1f} m away"
        self._goal = xy[first]
        self.tour = Tour(xy, worth, first)
        return Choice(xy[first], (), None, status)

    def _first(self, roadmap: Roadmap, xy: np.ndarray, away: np.ndarray, worth: np.ndarray) -> int:
        """Return the number of the place to go to first, by the configuration's mode."""
        if self._config.mode == "rate":
            return int(np.argmax(worth / np.maximum(away, 0.1)))
        if self._config.mode == "difference":
            return int(np.argmax(worth - self._config.price * away))
        between = np.array([roadmap.at(roadmap.distances_from(place), xy) for place in xy])
        longest = 10.0 * float(np.max(between[np.isfinite(between)], initial=1.0))
        order, _ = best_order(away, np.where(np.isfinite(between), between, longest), worth)
        return int(order[0])

    def _is_visited(self, xy: np.ndarray) -> bool:
        """Return True where this place was a reached goal: the gain that is still expected there cannot be observed."""
        return any(math.hypot(*(place - xy)) < self._config.same_place for place in self._visited)


def _strip(camera: Camera, share: float) -> Camera:
    """Return the camera with the middle ``share`` of its rows.

    Walls are known up to where they were seen. Rows above would see over them into unknown space that does not exist.
    """
    rows = max(1, round(share * camera.height))
    return Camera(camera.width, rows, camera.fx, camera.fy, camera.cx, camera.cy - 0.5 * (camera.height - rows))


class MiExplorerAgent:
    """Explore by mutual information; the pose is observed."""

    name = "mi_explorer"
    robot = "holonomic"
    task = "explore"
    needs_pose = True
    needs_map = False

    def __init__(self, config: MiExplorerConfig | None = None) -> None:
        self._strategy = MutualInformation(config or MiExplorerConfig())
        self._explorer = Explorer(self._strategy)
        self.reset, self.act = self._explorer.reset, self._explorer.act

    @property
    def tour(self) -> Tour | None:
        """Return the gains from which the last viewpoint was chosen; None before the first choice."""
        return self._strategy.tour

    @property
    def map(self) -> VoxelMap:
        """Return the belief over the apartment, world frame."""
        return self._explorer.map
