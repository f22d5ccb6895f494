"""Relocalise a robot on a floor from nowhere: ``argmax_z log p(x | z, M)`` over all poses of a known map (ours).

An image is compared with panoramas of the map at every place and heading. The best candidates are aligned to the map
rendered at each of them, and weighed by the model's likelihood. A pose is accepted where the image fixes all of its
coordinates and no other place explains the image as well. Ambiguity is a value: where places look alike, the result
holds all of them, and the images after a motion decide (:meth:`Relocaliser.narrowed`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, matrix_to_planar, planar_to_matrix, wrap_angle
from vssm_gym.inference.alignment.aliasing import APART
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.relocalisation.cylinder import Cylinder, CylinderConfig
from vssm_gym.inference.relocalisation.likelihood import ComparisonConfig, compare, peaks
from vssm_gym.inference.relocalisation.panoramas import Panoramas
from vssm_gym.inference.relocalisation.refinement import RefinementConfig, refine
from vssm_gym.inference.tracking import keyframes
from vssm_gym.inference.tracking.camera_filter import camera_twists
from vssm_gym.inference.tracking.config import COMMANDED, TrackingConfig
from vssm_gym.inference.tracking.error_covariance import nothing
from vssm_gym.inference.tracking.localise import Relocalisation, begin_at, readable, shrunk
from vssm_gym.inference.tracking.recovery import Attempt, RecoveryConfig, attempt, confirmed
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model import emission
from vssm_gym.model.emission import MAX_DEPTH, RGBD
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import PLANAR


class Outcome(Enum):
    """Enumerate what an image says about where it was taken."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"  # several places explain it alike, or it does not fix the pose at one of them
    NOTHING = "nothing fits"


@dataclass(frozen=True)
class Hypothesis:
    """Hold a pose that may be that of the robot.

    Attributes:
        planar: ``(3,)`` x, y (m), heading (rad) of the body in the map's frame.
        log_prob: ``log p(x | z, M)`` of the images so far, mean of a pixel, summed over images, nats.
    """

    planar: Float[np.ndarray, "3"]
    log_prob: float


@dataclass(frozen=True)
class Found:
    """Hold the outcome for one image.

    Attributes:
        outcome: what the image says.
        hypotheses: poses that explain it alike, the likeliest first; one where the pose was found.
        belief: over the body where the pose was found, else None.
    """

    outcome: Outcome
    hypotheses: tuple[Hypothesis, ...] = ()
    belief: GaussianBelief | None = None


@dataclass(frozen=True)
class RelocaliserConfig:
    """Configure effort and acceptance; chosen on the apartments that filters are tuned on."""

    cylinder: CylinderConfig = field(default_factory=CylinderConfig)
    comparison: ComparisonConfig = field(default_factory=ComparisonConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    # The scale of the geometry matches the roughness of a map with cells of 5 cm.
    recovery: RecoveryConfig = field(
        default_factory=lambda: RecoveryConfig(
            align=AlignConfig(geo_sigma=0.012, levels=(4, 2, 1), iterations=(10, 6, 5))
        )
    )
    tracking: TrackingConfig = COMMANDED  # of the covariance of an accepted pose
    scales: EmissionScales = field(default_factory=EmissionScales)
    margin: float = 0.7  # nats a pixel: a place that is less likely by less explains the image as well
    least: float = -1.0  # nats a pixel: an image that is less likely is not explained
    kept: int = 8  # hypotheses at most
    min_reading: float = 0.3  # share of the pixels with depth
    min_contrast: float = 0.02  # standard deviation of the luminance


@dataclass(frozen=True)
class Relocaliser:
    """Find a robot in a map.

    Attributes:
        map: that it is found in.
        rig: the camera and its pose on the body.
        panoramas: the index of the map.
        cylinder: of the camera.
        max_depth: range of the rendering, m.
        config: effort and acceptance.
    """

    map: VoxelMap
    rig: Rig
    panoramas: Panoramas
    cylinder: Cylinder
    max_depth: float
    config: RelocaliserConfig

    @classmethod
    def of(
        cls,
        m: VoxelMap,
        rig: Rig,
        places: Float[np.ndarray, "n 2"],
        max_depth: float = MAX_DEPTH,
        config: RelocaliserConfig = RelocaliserConfig(),
    ) -> "Relocaliser":
        """Build the index of a map: about 5 ms a place.

        Args:
            m: the map; its z axis points up, and the floor is at 0.
            rig: the camera and its pose on the body, whose origin is on the floor.
            places: of the camera, m: where the body is free, about 0.25 m apart.
            max_depth: range of the rendering, m.
            config: effort and acceptance.

        Raises:
            InputError: no place, or a camera that looks straight up or down.
        """
        places = np.asarray(places, np.float64)
        if places.ndim != 2 or places.shape[1:] != (2,) or not len(places) or not np.isfinite(places).all():
            raise InputError("Relocaliser.of", "places", f"(n, 2) finite places; found shape {places.shape}")
        cylinder = Cylinder.of(rig, config.cylinder)
        return cls(m, rig, Panoramas.of(m, cylinder, places, max_depth), cylinder, max_depth, config)

    def find(self, image: RGBD) -> Found:
        """Relocalise an image, knowing nothing (eq. I38).

        Args:
            image: at the camera's size.
        """
        if not self._is_legible(image):
            return Found(Outcome.NOTHING)
        ring = self.cylinder.resample(np.asarray(image.rgb), np.asarray(image.depth))
        comparison = self.config.comparison
        scores = compare(ring, self.panoramas, self.cylinder, comparison)
        candidates = peaks(scores, self.panoramas, self.config.cylinder.step, comparison)
        return self._judge(image, [Hypothesis(self.planar(*candidate), 0.0) for candidate in candidates])

    def narrowed(
        self,
        hypotheses: Sequence[Hypothesis],
        control: Float[np.ndarray, "m"],
        transition: Transition,
        dt: float,
        image: RGBD,
    ) -> Found:
        """Carry hypotheses on by a command, and let the next image decide between them (eq. I39).

        Args:
            hypotheses: of the images so far.
            control: of the transition, since the last image.
            transition: of the body on the floor.
            dt: seconds since the last image.
            image: the next one, at the camera's size.

        Returns:
            The outcome. An image that shows nothing leaves the hypotheses where the command leads them.
        """
        moved = [self._moved(one, control, transition, dt) for one in hypotheses]
        if not self._is_legible(image):
            return Found(Outcome.AMBIGUOUS if moved else Outcome.NOTHING, tuple(moved))
        return self._judge(image, moved)

    def planar(self, place: int, heading: int) -> Float[np.ndarray, "3"]:
        """Return the pose of the body whose camera is at a place of the index, at a column's heading."""
        angle = float(wrap_angle(heading * self.config.cylinder.step))
        ahead, left = np.asarray(self.rig.T_body_cam, np.float64)[:2, 3]
        x, y = self.panoramas.places[place]
        c, s = math.cos(angle), math.sin(angle)
        return np.array([x - c * ahead + s * left, y - s * ahead - c * left, angle])

    def _is_legible(self, image: RGBD) -> bool:
        """Return True if an image has enough readings and contrast to say where it was taken."""
        tracking = replace(self.config.tracking, min_reading=self.config.min_reading)
        return readable(image, tracking) and float(jnp.std(jnp.mean(image.rgb, -1))) >= self.config.min_contrast

    def _moved(self, one: Hypothesis, control: np.ndarray, transition: Transition, dt: float) -> Hypothesis:
        mean = _expected(transition, jnp.asarray(one.planar, jnp.float32), jnp.asarray(control, jnp.float32), dt)
        return replace(one, planar=np.asarray(mean, np.float64))

    def _judge(self, image: RGBD, candidates: list[Hypothesis]) -> Found:
        """Refine candidates; return the outcome."""
        c, T_body_cam = self.config, np.asarray(self.rig.T_body_cam, np.float64)
        if not candidates:
            return Found(Outcome.NOTHING)
        poses = np.stack([planar_to_matrix(one.planar) @ T_body_cam for one in candidates])
        # Their number is part of what is compiled: a few hypotheses, or all candidates of an image.
        size = c.kept if len(poses) <= c.kept else c.comparison.candidates
        padded = np.concatenate([poses, np.repeat(poses[:1], size - len(poses), axis=0)])
        small, rig = shrunk(image, self.rig, c.refinement.width)
        basis = camera_twists(PLANAR, rig)
        refined = refine(
            self.map, jnp.asarray(padded, jnp.float32), small, rig.camera, basis, self.max_depth, c.refinement, c.scales
        )
        T, likelihood = np.asarray(refined.T_world_cam, np.float64), np.asarray(refined.log_prob, np.float64)
        total = likelihood[: len(candidates)] + [one.log_prob for one in candidates]
        alike = self._alike(T, total)
        hypotheses = tuple(
            Hypothesis(np.asarray(matrix_to_planar(T[k] @ inverse(T_body_cam)), np.float64), float(total[k]))
            for k in alike
        )
        if not alike or likelihood[alike[0]] < c.least:
            return Found(Outcome.NOTHING)
        if len(alike) > 1:
            return Found(Outcome.AMBIGUOUS, hypotheses)
        return self._accepted(image, jnp.asarray(T[alike[0]], jnp.float32), hypotheses)

    def _alike(self, T_world_cam: np.ndarray, total: np.ndarray) -> list[int]:
        """Return the candidates that are apart and about as likely as the likeliest, best first."""
        kept: list[int] = []
        for k in np.argsort(-total):
            if not np.isfinite(total[k]) or (kept and total[k] < total[kept[0]] - self.config.margin):
                break
            if len(kept) < self.config.kept and all(_apart(T_world_cam[k], T_world_cam[j]) for j in kept):
                kept.append(int(k))
        return kept

    def _accepted(self, image: RGBD, T_world_cam: Float[Array, "4 4"], hypotheses: tuple[Hypothesis, ...]) -> Found:
        """Accept the only place that explains an image if the image fixes the pose there."""
        c, camera = self.config, self.rig.camera
        basis = camera_twists(PLANAR, self.rig)
        rendered = emission.render(self.map, T_world_cam, camera, self.max_depth)
        found = attempt(T_world_cam, rendered, image, camera, basis, c.recovery)
        if not found.accepted:
            return Found(Outcome.AMBIGUOUS, hypotheses)
        rendered = emission.render(self.map, found.T_world_cam, camera, self.max_depth)
        if not confirmed(found, rendered, image, camera, basis, c.recovery):
            return Found(Outcome.AMBIGUOUS, hypotheses)
        belief = self._belief(found, image)
        planar = np.asarray(belief.mean, np.float64)
        return Found(Outcome.FOUND, (replace(hypotheses[0], planar=planar),), belief)

    def _belief(self, found: Attempt, image: RGBD) -> GaussianBelief:
        """Return the belief at an accepted pose, with the errors of the map's surfaces."""
        c = self.config
        given = Relocalisation(self.map, keyframes.empty(self.rig.camera), self.max_depth, c.recovery)
        n = PLANAR.twists.shape[1]
        return begin_at(found, PLANAR, image, self.rig, c.tracking, given, nothing(n)).past.belief


_expected = jax.jit(lambda transition, mean, control, dt: transition.expected(mean, control, dt))


def _apart(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True for camera poses of different places or headings."""
    turned = 0.5 * (float(np.trace(a[:3, :3].T @ b[:3, :3])) - 1.0)
    return math.dist(a[:3, 3], b[:3, 3]) > APART or math.acos(min(1.0, max(-1.0, turned))) > APART
