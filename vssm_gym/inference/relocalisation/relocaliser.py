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
from vssm_gym.inference.alignment.agreement import Agreement
from vssm_gym.inference.alignment.aliasing import APART
from vssm_gym.inference.alignment.residuals import AlignConfig
from vssm_gym.inference.filter import Rig
from vssm_gym.inference.relocalisation.colour_view import ColourViewConfig, align_views, picture_agreement
from vssm_gym.inference.relocalisation.cylinder import Cylinder, CylinderConfig
from vssm_gym.inference.relocalisation.likelihood import ComparisonConfig, compare, peaks
from vssm_gym.inference.relocalisation.panoramas import Panoramas
from vssm_gym.inference.relocalisation.refinement import Refined, RefinementConfig, refine
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
    # The scale of the geometry matches the roughness of a map with cells of 5 cm. All other places have been refused
    # before, so that colours have to agree less than where a camera is looked for around a keyframe alone.
    recovery: RecoveryConfig = field(
        default_factory=lambda: RecoveryConfig(
            align=AlignConfig(geo_sigma=0.012, levels=(4, 2, 1), iterations=(10, 6, 5)), min_correlation=0.6
        )
    )
    tracking: TrackingConfig = COMMANDED  # of the covariance of an accepted pose
    scales: EmissionScales = field(default_factory=EmissionScales)
    colour_view: ColourViewConfig = field(default_factory=ColourViewConfig)
    margin: float = 0.7  # nats a pixel: a place that is less likely by less explains the image as well
    least: float = -1.0  # nats a pixel: an image that is less likely is not explained
    kept: int = 8  # hypotheses at most
    min_reading: float = 0.3  # share of the pixels with depth
    min_contrast: float = 0.02  # standard deviation of the luminance
    picture_margin: float = 0.25  # as ``margin``, of a picture without depth
    picture_correlation: float = 0.6  # of the luminances of a picture and an image of the same place, at least
    picture_share: float = 0.2  # of the image that the picture shows, too
    picture_kept: int = 5  # hypotheses of a picture, however unlikely the last ones are


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
        """Relocalise an image, knowing nothing (eqs. I43 and I44).

        Args:
            image: at the camera's size.
        """
        if not self._is_legible(image):
            return Found(Outcome.NOTHING)
        ring = self.cylinder.resample(np.asarray(image.rgb), np.asarray(image.depth))
        comparison = self.config.comparison
        scores = compare(ring, self.panoramas, self.cylinder, comparison)
        candidates = peaks(scores, self.panoramas.places, self.config.cylinder.step, comparison)
        return self._judge(image, [Hypothesis(self.planar(*candidate), 0.0) for candidate in candidates])

    def narrowed(
        self,
        hypotheses: Sequence[Hypothesis],
        control: Float[np.ndarray, "m"],
        transition: Transition,
        dt: float,
        image: RGBD,
    ) -> Found:
        """Carry hypotheses on by a command, and let the next image decide between them (eq. I45).

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

    def find_picture(self, rgb: Float[np.ndarray, "height width 3"]) -> Found:
        """Find where a picture without depth was taken by such a camera (eq. I46).

        Args:
            rgb: in [0, 1], at the camera's size.

        Returns:
            The outcome, without a belief. Hypotheses are the likeliest places, also where one of them is found: whoever
            drives there may find that it was not the one.
        """
        c = self.config
        if float(np.std(rgb.mean(-1))) < c.min_contrast:
            return Found(Outcome.NOTHING)
        scores = compare(self.cylinder.resample(rgb, None), self.panoramas, self.cylinder, c.comparison)
        found = peaks(scores, self.panoramas.places, self.config.cylinder.step, c.comparison)
        poses, T_body_cam = self._poses([self.planar(*one) for one in found], c.comparison.candidates)
        small, rig = shrunk(without_depth(rgb), self.rig, c.colour_view.width)
        basis = camera_twists(PLANAR, rig)
        aligned = align_views(self.map, poses, small.rgb, rig.camera, basis, self.max_depth, c.colour_view, c.scales)
        T, likelihood = _on_host(aligned, len(found))
        best = self._alike(T, likelihood, math.inf)[: c.picture_kept]
        alone = len(best) == 1 or likelihood[best[1]] < likelihood[best[0]] - c.picture_margin
        hypotheses = tuple(_hypothesis(T[k], T_body_cam, likelihood[k]) for k in best)
        return Found(Outcome.FOUND if alone else Outcome.AMBIGUOUS, hypotheses)

    def shows_picture(
        self, image: RGBD, planar: Float[np.ndarray, "3"], rgb: np.ndarray, taken: Float[np.ndarray, "3"]
    ) -> bool:
        """Return True if a camera image agrees with a picture, by the colours of what both show.

        Args:
            image: at the camera's size.
            planar: pose of the body with it, m and rad.
            rgb: the picture, in [0, 1], at that size.
            taken: pose of the body where the picture may have been taken.
        """
        c = self.config
        agreed = compared(image, planar, rgb, taken, self.rig, c.colour_view)
        return float(agreed.correlation) >= c.picture_correlation and float(agreed.share) >= c.picture_share

    def planar(self, place: int, heading: int) -> Float[np.ndarray, "3"]:
        """Return the pose of the body whose camera is at a place of the index, at a column's heading."""
        return planar_of(self.panoramas.places[place], heading * self.config.cylinder.step, self.rig)

    def _is_legible(self, image: RGBD) -> bool:
        """Return True if an image has enough readings and contrast to say where it was taken."""
        tracking = replace(self.config.tracking, min_reading=self.config.min_reading)
        return readable(image, tracking) and float(jnp.std(jnp.mean(image.rgb, -1))) >= self.config.min_contrast

    def _moved(self, one: Hypothesis, control: np.ndarray, transition: Transition, dt: float) -> Hypothesis:
        mean = _expected(transition, jnp.asarray(one.planar, jnp.float32), jnp.asarray(control, jnp.float32), dt)
        return replace(one, planar=np.asarray(mean, np.float64))

    def _judge(self, image: RGBD, candidates: list[Hypothesis]) -> Found:
        """Refine candidates; return the outcome."""
        c = self.config
        if not candidates:
            return Found(Outcome.NOTHING)
        # Their number is part of what is compiled: a few hypotheses, or all candidates of an image.
        size = c.kept if len(candidates) <= c.kept else c.comparison.candidates
        poses, T_body_cam = self._poses([one.planar for one in candidates], size)
        small, rig = shrunk(image, self.rig, c.refinement.width)
        basis = camera_twists(PLANAR, rig)
        refined = refine(self.map, poses, small, rig.camera, basis, self.max_depth, c.refinement, c.scales)
        T, likelihood = _on_host(refined, len(candidates))
        total = likelihood + [one.log_prob for one in candidates]
        alike = self._alike(T, total, c.margin)
        hypotheses = tuple(_hypothesis(T[k], T_body_cam, total[k]) for k in alike)
        if not alike or likelihood[alike[0]] < c.least:
            return Found(Outcome.NOTHING)
        if len(alike) > 1:
            return Found(Outcome.AMBIGUOUS, hypotheses)
        return self._accepted(image, jnp.asarray(T[alike[0]], jnp.float32), hypotheses)

    def _poses(self, planar: list[np.ndarray], size: int) -> tuple[Float[Array, "n 4 4"], np.ndarray]:
        """Return camera poses, the first one repeated up to ``size``, and the camera's pose on the body in float64."""
        T_body_cam = np.asarray(self.rig.T_body_cam, np.float64)
        poses = np.stack([planar_to_matrix(one) @ T_body_cam for one in planar])
        padded = np.concatenate([poses, np.repeat(poses[:1], size - len(poses), axis=0)])
        return jnp.asarray(padded, jnp.float32), T_body_cam

    def _alike(self, T_world_cam: np.ndarray, total: np.ndarray, margin: float) -> list[int]:
        """Return the candidates that are apart, and less likely than the likeliest by no more than ``margin``."""
        kept: list[int] = []
        for k in np.argsort(-total):
            if not np.isfinite(total[k]) or (kept and total[k] < total[kept[0]] - margin):
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


def compared(
    image: RGBD,
    planar: Float[np.ndarray, "3"],
    rgb: np.ndarray,
    taken: Float[np.ndarray, "3"],
    rig: Rig,
    config: ColourViewConfig,
) -> Agreement:
    """Compare a camera image with a picture by the colours of what both show.

    Args:
        image: at the camera's size.
        planar: pose of the body with it, m and rad.
        rgb: the picture, in [0, 1], at that size.
        taken: pose of the body where the picture may have been taken.
        rig: the camera and its pose on the body.
        config: effort of their alignment.
    """
    T_body_cam = np.asarray(rig.T_body_cam, np.float64)
    T_world_image, T_world_picture = (planar_to_matrix(np.asarray(p)) @ T_body_cam for p in (planar, taken))
    small, small_rig = shrunk(image, rig, config.width)
    picture, _ = shrunk(without_depth(rgb), rig, config.width)
    T = jnp.asarray(inverse(T_world_picture) @ T_world_image, jnp.float32)
    return picture_agreement(small, picture.rgb, T, small_rig.camera, camera_twists(PLANAR, small_rig), config)


def planar_of(place: Float[np.ndarray, "2"], heading: float, rig: Rig) -> Float[np.ndarray, "3"]:
    """Return the pose of the body that looks along ``heading`` (rad) with its camera at ``place`` (m)."""
    angle = float(wrap_angle(heading))
    ahead, left = np.asarray(rig.T_body_cam, np.float64)[:2, 3]
    x, y = place
    c, s = math.cos(angle), math.sin(angle)
    return np.array([x - c * ahead + s * left, y - s * ahead - c * left, angle])


def without_depth(rgb: np.ndarray) -> RGBD:
    """Return the image of a picture, which has no depth."""
    depth = jnp.zeros(rgb.shape[:2])
    return RGBD(depth, jnp.asarray(rgb, jnp.float32), depth > 0.0, depth > 0.0)


def _on_host(refined: Refined, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the first ``n`` poses and log likelihoods, float64."""
    T, likelihood = jax.device_get((refined.T_world_cam, refined.log_prob))
    return np.asarray(T, np.float64)[:n], np.asarray(likelihood, np.float64)[:n]


def _hypothesis(T_world_cam: np.ndarray, T_body_cam: np.ndarray, log_prob: float) -> Hypothesis:
    return Hypothesis(matrix_to_planar(T_world_cam @ inverse(T_body_cam)), float(log_prob))


def _apart(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True for camera poses of different places or headings."""
    turned = 0.5 * (float(np.trace(a[:3, :3].T @ b[:3, :3])) - 1.0)
    return math.dist(a[:3, 3], b[:3, 3]) > APART or math.acos(min(1.0, max(-1.0, turned))) > APART
