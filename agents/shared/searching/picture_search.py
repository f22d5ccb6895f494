"""Search a map that grows for the place where a picture was taken, a little at every step.

A grid of places covers what the map shows to be free. In each step the panoramas of a few places are rendered, of those
around which most has become known that their last one did not show, and compared with the picture (eq. I43 by colours
alone). Now and then the best poses so far are aligned to the picture in the map of that moment (eq. I46) and weighed by

    rho = corr(luminance of the picture, luminance of the map)      over the share of the picture that the map shows

A step's work is bounded, however large the map is.
"""

import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from scipy import ndimage

from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.shared.map_index import SPACING, rig_of
from vssm_gym.agents.shared.searching.picture_matches import Match, Matches, MatchesConfig
from vssm_gym.geometry.transforms import inverse, matrix_to_planar, planar_to_matrix
from vssm_gym.inference.relocalisation.colour_view import ColourViewConfig, align_views, view_agreement
from vssm_gym.inference.relocalisation.cylinder import Cylinder, CylinderConfig
from vssm_gym.inference.relocalisation.likelihood import ComparisonConfig, compare, peaks
from vssm_gym.inference.relocalisation.panoramas import Panoramas
from vssm_gym.inference.relocalisation.relocaliser import compared, planar_of, without_depth
from vssm_gym.inference.tracking.camera_filter import camera_twists
from vssm_gym.inference.tracking.localise import shrunk
from vssm_gym.maps.block_table import BLOCK
from vssm_gym.maps.voxel_map import OBSERVED_PRECISION, VoxelMap
from vssm_gym.model.emission import MAX_DEPTH, RGBD
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.planning.floor_plan import FloorPlan

TIGHTER = 0.04  # m, by which a place may be tighter than the body: a map's surfaces err


@dataclass(frozen=True)
class PictureSearchConfig:
    """Configure the effort of a step; lengths in metres."""

    spacing: float = SPACING  # of the places
    extent: float = 36.0  # along x and y, around the start
    sight: float = 3.0  # half the side of the box around a place in which what becomes known calls for a new panorama
    panoramas: int = 8  # rendered in a step
    least: int = 500  # cells that have become known, for a new panorama: a block of 0.6 m
    every: int = 4  # steps between two alignments
    candidates: int = 3  # poses that are aligned at once
    cylinder: CylinderConfig = field(default_factory=lambda: CylinderConfig(map_samples=1))
    # A cell that the map does not show costs what cells of the best wrong places cost: a true place of which the map
    # shows half is among the best then.
    comparison: ComparisonConfig = field(default_factory=lambda: ComparisonConfig(candidates=64, unseen=0.6))
    shown: float = 0.35  # share of a view that the map shows, from which on it is a candidate
    matches: MatchesConfig = field(default_factory=MatchesConfig)
    # Of a camera image at the picture's place: mean residual of the colours in standard deviations, at most;
    # correlation and share of what the picture shows of it, at least.
    most_cost: float = 0.9
    least_correlation: float = 0.75
    least_share: float = 0.2
    colour_view: ColourViewConfig = field(default_factory=ColourViewConfig)


class PictureSearch:
    """Search for one picture; see the module."""

    def __init__(self, config: PictureSearchConfig, context: AgentContext, rgb: np.ndarray) -> None:
        """Begin with nothing seen.

        Args:
            config: effort.
            context: of the episode, its start is the grid's middle.
            rgb: the picture, ``(height, width, 3)`` in [0, 1].
        """
        self._config, self._rig, self._rgb = config, rig_of(context), rgb
        self._cylinder = Cylinder.of(self._rig, config.cylinder)
        self._ring = self._cylinder.resample(rgb, None)
        small, self._small_rig = shrunk(without_depth(rgb), self._rig, config.colour_view.width)
        self._picture = small.rgb
        self._basis = camera_twists(PLANAR, self._small_rig)
        n = round(config.extent / config.spacing)
        self._corner = np.asarray(context.start_pose, np.float64)[:2] - 0.5 * config.spacing * (n - 1)
        self._room = 0.5 * context.body_length - TIGHTER
        self._grid = self._corner + config.spacing * np.moveaxis(np.indices((n, n)), 0, -1)
        self._known = np.zeros((n, n))  # cells known around a place when its panorama was rendered
        self._row = np.full((n, n), -1)  # of ``_scores``
        self.places = np.empty((0, 2))  # (n, 2) m, with a panorama
        self.shares = np.empty((0, config.cylinder.columns))  # of the view at each heading there that the map shows
        self._scores = np.empty((0, config.cylinder.columns), np.float32)
        self._aligned: dict[tuple[int, int], float] = {}  # score of each place and heading when it was aligned last
        self._steps = self._idle = 0
        self.matches = Matches(config.matches)

    def step(self, m: VoxelMap, plan: FloorPlan) -> None:
        """Do one step's work, and update ``matches``.

        Args:
            m: the map as it is now; not kept.
            plan: its floor plan.
        """
        c = self._config
        self._steps += 1
        rendered = self._look(m, plan)
        self._idle = 0 if rendered else self._idle + 1
        if self._steps % c.every == 0 and len(self.places) and (poses := self._candidates()):
            self._idle = 0
            for match in self.align(m, poses):
                self.matches.add(match)

    @property
    def is_done(self) -> bool:
        """Return True where nothing in the map is left to compare with the picture."""
        return self._idle >= self._config.every

    def align(self, m: VoxelMap, poses: list[np.ndarray]) -> list[Match]:
        """Align the picture from poses ``(3,)`` of the body, at most ``candidates``; the likeliest first."""
        c, T_body_cam = self._config, np.asarray(self._rig.T_body_cam, np.float64)
        T = np.stack([planar_to_matrix(pose) @ T_body_cam for pose in poses])
        padded = np.concatenate([T, np.repeat(T[:1], c.candidates - len(T), axis=0)])
        camera, scales = self._small_rig.camera, EmissionScales()
        aligned = align_views(
            m, jnp.asarray(padded, jnp.float32), self._picture, camera, self._basis, MAX_DEPTH, c.colour_view, scales
        )
        agreed = view_agreement(m, aligned.T_world_cam, self._picture, camera, MAX_DEPTH)
        T_world_cam, log_prob, (correlation, share) = jax.device_get((aligned.T_world_cam, aligned.log_prob, agreed))
        found = [
            Match(
                matrix_to_planar(np.asarray(T_world_cam[k], np.float64) @ inverse(T_body_cam)),
                float(log_prob[k]),
                float(correlation[k]),
                float(share[k]),
            )
            for k in range(len(poses))
        ]
        return sorted((one for one in found if np.isfinite(one.planar).all()), key=lambda one: -one.log_prob)

    def agrees(self, image: RGBD, planar: np.ndarray, taken: np.ndarray) -> bool:
        """Return True where a camera image agrees with the picture, by the colours of what both show.

        Args:
            image: at the camera's size.
            planar: ``(3,)`` of the body with it, m and rad.
            taken: the same where the picture may have been taken.
        """
        c = self._config
        found = compared(image, planar, self._rgb, taken, self._rig, c.colour_view)
        fits = float(found.cost) <= c.most_cost and float(found.correlation) >= c.least_correlation
        return fits and float(found.share) >= c.least_share

    def _candidates(self) -> list[np.ndarray]:
        """Return the poses of the highest scores that are apart and have not been aligned with that score."""
        c = self._config
        scores = np.where(self.shares >= c.shown, self._scores, -np.inf)
        best = peaks(scores, self.places, c.cylinder.step, c.comparison)
        due = [at for at in best if self._aligned.get(at) != self._scores[at]][: c.candidates]
        self._aligned.update((at, float(self._scores[at])) for at in due)
        return [planar_of(self.places[place], heading * c.cylinder.step, self._rig) for place, heading in due]

    def _look(self, m: VoxelMap, plan: FloorPlan) -> bool:
        """Render the panoramas that are due most, and compare them with the picture; return False where none is."""
        c = self._config
        known = self._known_around(m)
        # Where a panorama shows all there is, nothing that becomes known changes it.
        unseen = np.ones(known.shape)
        looked = self._row >= 0
        unseen[looked] = 1.0 - self.shares[self._row[looked]].mean(axis=1)
        due = np.where(self._is_free(plan), unseen * (known - self._known), -np.inf)
        chosen = np.argsort(-due, axis=None, kind="stable")[: c.panoramas]
        chosen = chosen[due.reshape(-1)[chosen] >= c.least]
        if not len(chosen):
            return False
        at = np.unravel_index(chosen, due.shape)
        panoramas = Panoramas.of(m, self._cylinder, self._grid[at], MAX_DEPTH, c.panoramas)
        scores = compare(self._ring, panoramas, self._cylinder, c.comparison)
        new = self._row[at] < 0
        self._row[at] = np.where(new, len(self.places) + np.cumsum(new) - 1, self._row[at])
        self.places = np.concatenate([self.places, self._grid[at][new]])
        self.shares = np.concatenate([self.shares, np.zeros((new.sum(), scores.shape[1]))])
        self._scores = np.concatenate([self._scores, scores[new]])
        self._scores[self._row[at]], self.shares[self._row[at]] = scores, self._shown(panoramas)
        self._known[at] = known[at]
        return True

    def _shown(self, panoramas: Panoramas) -> np.ndarray:
        """Return the share of the view at each place and heading that the map shows, ``(n, columns)``."""
        cylinder, columns = self._cylinder, self._cylinder.config.columns
        seen = panoramas.ring.seen.mean(axis=0)[:, :columns]
        window = (cylinder.first + np.arange(cylinder.columns) + np.arange(columns)[:, None]) % columns
        return seen[:, window].mean(axis=-1)

    def _known_around(self, m: VoxelMap) -> np.ndarray:
        """Return the number of observed cells of the map in the box around each place, to a block."""
        edge = BLOCK * float(m.voxel_size)
        count = np.asarray(_observed(m.occupancy_precision)).reshape(-1)
        by_block = count.reshape(m.blocks) if m.table is None else count[np.asarray(m.table.slot)]
        size = 2 * math.ceil(self._config.sight / edge) + 1
        around = ndimage.uniform_filter(by_block.sum(axis=2).astype(np.float64), size, mode="constant") * size**2
        block = np.floor((self._grid - np.asarray(m.origin, np.float64)[:2]) / edge).astype(int)
        block = np.clip(block, 0, np.array(around.shape) - 1)
        return around[block[..., 0], block[..., 1]]

    def _is_free(self, plan: FloorPlan) -> np.ndarray:
        """Mark the places where the body is free, to a cell."""
        space = plan.clearance()
        cell = np.floor(space.to_grid(self._grid) + 0.5).astype(int)
        inside = np.all((cell >= 0) & (cell < space.clearance.shape), axis=-1)
        held = np.where(inside[..., None], cell, 0)
        return inside & (space.clearance[held[..., 0], held[..., 1]] >= self._room)


@jax.jit
def _observed(precision: Array) -> Array:
    """Return the number of observed cells of each block."""
    return jnp.sum(precision > OBSERVED_PRECISION, axis=-1)
