"""``mi_explorer``: goes and looks where imagined images teach its map most, in the order that leaves least undone.

    I(M; x | z) = sum_cells 1/2 log(1 + n lambda_u / lambda)     gain of looks z together; what they share is in n
    order = argmin sum_legs |leg| (gain not yet made)            ``mode`` "coverage": a tour that leaves nothing behind
    goal = argmax gain / way,  or  gain - price way              ``mode`` "rate", "difference": greedy, as published

At every choice it first asks what a look in another direction from where it stands would teach: that costs time and no
way. Else it takes up to ``places`` candidates that see different parts of the unknown, imagines a look around at each,
and goes to the first of the best order.
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
from vssm_gym.planning.exploration.frontier import REACH
from vssm_gym.planning.exploration.information import Gain, InformationConfig, gain_of_paths
from vssm_gym.planning.exploration.minimum_latency_tour import MOST, best_order

Gains: TypeAlias = Callable[[np.ndarray, np.ndarray], Gain]  # of (poses, paths through them)
NEAR = 0.2  # m: as good as the same place
AROUND = 4  # looks of a quarter turn make a look around


@dataclass(frozen=True)
class MiExplorerConfig:
    """What is a candidate, what gain is worth, and what of it is too little."""

    mode: Literal["coverage", "rate", "difference"] = "coverage"
    price: float = 5000.0  # nats a metre, of the mode "difference"
    spacing: float = 0.5  # m between candidates
    hazard: tuple[float, float] = (0.25, 3.0)  # 1/m, of surfaces in unknown space: in the building's outline, beyond
    least_share: float = 0.1  # of the greatest gain, below which a place waits
    least_area: float = 0.05  # m^2 of unknown space that a candidate sees
    places: int = 10  # candidates that are imagined, at most
    decay: float = 0.2  # 1/m, by which nearer ones are taken for them
    least_gain: float = 1000.0  # nats, of a place that is worth going to
    headings: int = 8  # of looks from here
    least_look: float = 600.0  # nats, of one of them less the turn's price
    look_share: float = 0.003  # the same on the way, of the whole tour's gain
    turn_price: float = 600.0  # nats a radian, of the time that it takes: a small part of what driving gains in it
    pose_weight: float = 1000.0  # nats of the map that a nat about the own pose is worth: without it the map is spoilt
    repeat: tuple[float, float] = (0.3, 0.5)  # m and rad: looks so close to one that was made are not made again
    strip: float = 1.0 / 3.0  # of the image's height, around the horizon: see `_strip`
    # A cell that was observed is known to 3 cm: looking again would outweigh, by the number of known cells, a small
    # place that nobody has seen.
    information: InformationConfig = field(
        default_factory=lambda: InformationConfig(max_depth=REACH, known=OBSERVED_PRECISION, ground=0.0)
    )

    def __post_init__(self) -> None:
        if self.mode not in ("coverage", "rate", "difference"):
            raise InputError("MiExplorerConfig", "mode", f"coverage, rate or difference; found {self.mode!r}")
        if not (len(self.hazard) == 2 and min(self.hazard) >= 0.0):
            raise InputError("MiExplorerConfig", "hazard", f"two rates, at least 0 1/m; found {self.hazard!r}")
        if not 1 <= self.places <= MOST:
            raise InputError("MiExplorerConfig", "places", f"1 to {MOST}; found {self.places!r}")


@dataclass(frozen=True)
class Tour:
    """What a choice of place was made from.

    Attributes:
        xy: ``(n, 2)`` places, m.
        nats: ``(n,)`` what each would teach beside those before it, less its price: ``least_gain``, and what the robot
            would know less of its own pose there than at the best of them.
        first: the one that was chosen.
    """

    xy: np.ndarray
    nats: np.ndarray
    first: int


class MutualInformation:
    """:class:`~vssm_gym.agents.shared.strategy.ExplorationStrategy`: expected information; see the module."""

    def __init__(self, config: MiExplorerConfig) -> None:
        self._config = config

    def reset(self, seed: int) -> None:
        """Nothing here is random."""
        self.tour: Tour | None = None  # of the last choice of a place
        self._left = 0.0  # nats of the last tour
        self._looks: list[tuple[float, float, float]] = []  # poses (m, rad) of the looks that were made
        self._goal: np.ndarray | None = None
        self._visited: list[np.ndarray] = []  # goals that were reached, m

    def choose(self, situation: Situation) -> Choice | None:
        """A look from here, or the first place of a tour."""
        if situation.arrived and self._goal is not None and math.hypot(*(self._goal - situation.planar[:2])) < NEAR:
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
        """The look from here that teaches most for the turn, where that is enough."""
        c, (x, y, heading) = self._config, situation.planar
        within, apart = c.repeat
        made = [h for a, b, h in self._looks if math.hypot(a - x, b - y) < within]
        turns = np.arange(c.headings) * 2.0 * math.pi / c.headings
        fresh = np.array([t for t in turns if all(abs(wrap_angle(float(t - h))) > apart for h in made)])
        if len(fresh) == 0:
            return None
        planar = np.stack([np.full(len(fresh), x), np.full(len(fresh), y), fresh], axis=1)
        found = gain(np.concatenate([planar, situation.planar[None]]), np.arange(len(fresh))[:, None])
        nats = found.total + c.pose_weight * (found.pose[:-1] - found.pose[-1])  # beside what is seen from here anyway
        value = nats - c.turn_price * np.abs(wrap_angle(fresh - heading))
        k = int(np.argmax(value))
        # On the way only what is worth a stop; where it came to look, all there is to see.
        on_the_way = 0.0 if self._is_visited(situation.planar[:2]) else c.look_share * self._left
        if value[k] < max(c.least_look, on_the_way):
            return None
        self._looks.append((x, y, float(fresh[k])))
        return Choice(None, (float(fresh[k]),), None, f"looks for {nats[k]:.0f} nats")

    def _tour(self, situation: Situation, hazard: np.ndarray, gain: Gains) -> Choice | None:
        """Where to go first; None where no place is worth it."""
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
        turns = np.arange(AROUND) * 2.0 * math.pi / AROUND
        planar = np.column_stack([np.repeat(xy, AROUND, axis=0), np.tile(turns, len(xy))])
        # One trajectory through all of them: what a place adds to those before it.
        looked = gain(planar, np.arange(len(planar))[None])
        held = looked.pose.reshape(-1, AROUND).mean(axis=1)
        worth = np.diff(looked.along[0, AROUND - 1 :: AROUND], prepend=0.0) - c.least_gain
        worth += c.pose_weight * (held - held.max())  # where the robot would see nothing to tell its place by
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
        """The place to go to first, by the configuration's mode."""
        if self._config.mode == "rate":
            return int(np.argmax(worth / np.maximum(away, 0.1)))
        if self._config.mode == "difference":
            return int(np.argmax(worth - self._config.price * away))
        between = np.array([roadmap.at(roadmap.distances_from(place), xy) for place in xy])
        longest = 10.0 * float(np.max(between[np.isfinite(between)], initial=1.0))
        order, _ = best_order(away, np.where(np.isfinite(between), between, longest), worth)
        return int(order[0])

    def _is_visited(self, xy: np.ndarray) -> bool:
        """Whether this place was a goal that was reached: what it still promises is not there."""
        return any(math.hypot(*(place - xy)) < NEAR for place in self._visited)


def _strip(camera: Camera, share: float) -> Camera:
    """The camera with the middle ``share`` of its rows.

    Walls are known up to where they were seen. The rows above would look over them into an unknown that is not there.
    """
    rows = max(1, round(share * camera.height))
    return Camera(camera.width, rows, camera.fx, camera.fy, camera.cx, camera.cy - 0.5 * (camera.height - rows))


class MiExplorerAgent:
    """Exploration by mutual information; the pose is observed."""

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
        """What the last choice of a place was made from; None before there was one."""
        return self._strategy.tour

    @property
    def map(self) -> VoxelMap:
        """The belief over the apartment, world frame."""
        return self._explorer.map
