"""Smooth on-line, from nothing: time steps are unlocked one after the other, and the newest ones move together.

No map is needed to find a pose. A new image is aligned to the last one; then the states of the newest steps are found
together, with all their images and with earlier ones that see the same surfaces
(:mod:`~vssm_gym.inference.smoothing.window`). Earlier steps stay: drift is corrected where places are seen again, and
in the whole trajectory by smoothing all steps at the end. An image enters the map when its step leaves the window.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import inverse, se3_adjoint, se3_log
from vssm_gym.inference.alignment import gauss_newton, reference_view
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import AlignInfo
from vssm_gym.inference.filter import Clock, FilterInfo, Rig, untimed
from vssm_gym.inference.mapping import map_update, rolling_window
from vssm_gym.inference.mapping.map_update import MapUpdateConfig
from vssm_gym.inference.smoothing.gauss_newton import SmoothingConfig
from vssm_gym.inference.smoothing.window import Step, View, smooth_window, view_of, without_image
from vssm_gym.inference.status import Status
from vssm_gym.inference.tracking import start_poses
from vssm_gym.inference.tracking.camera_filter import begin, camera_pose, camera_twists
from vssm_gym.inference.tracking.config import TrackingConfig
from vssm_gym.inference.tracking.localise import checked, readable, seconds, shrunk
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.model.map_samples import MeasurementNoise
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief
from vssm_gym.model.transition.manifold import Manifold

SAME_VIEW_TURN = 0.5  # rad by which a view differs from another as much as by a metre
WINDOW_GATES = (0.1, 0.05, 0.05)  # m, of the iterations
HELD_STD = 1e-3  # m, rad: std of the first pose of the window, which the step before has left to it


@dataclass(frozen=True)
class OnlineConfig:
    """Configure the window and its effort.

    Args:
        smoothing: of the window; an iteration for each gate.
        tracking: of the alignment to the last image.
        update: of the map.
        free: newest steps, whose states move.
        held: earlier images at most, which stay and are compared with the newest.
        spacing: m between the views of earlier images that are kept; half a radian counts as much as a metre.
        least_shared: of the drawn elements, that an image must see to be accepted.
        most_kept: earlier images; beyond it every second one is forgotten.
        track_width: pixels to which images are shrunk, about.
        window_margin: share of the map's edge, as of PRISM.
    """

    smoothing: SmoothingConfig = field(default_factory=lambda: SmoothingConfig(elements=3000, gates=WINDOW_GATES))
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    update: MapUpdateConfig = field(default_factory=MapUpdateConfig)
    free: int = 8
    held: int = 8
    spacing: float = 0.35
    least_shared: float = 0.1
    most_kept: int = 600
    track_width: int | None = 160
    window_margin: float | None = 0.25


class Placed(NamedTuple):
    """Hold a step with what belongs to it besides."""

    step: Step
    image: RGBD | None  # at the camera's size, for the map; None: not accepted
    covariance: Float[np.ndarray, "n n"]  # of the state, about the world


class Earlier(NamedTuple):
    """Hold an earlier image that stays."""

    view: View
    T_world_cam: Float[np.ndarray, "4 4"]


@dataclass(frozen=True)
class OnlineState:
    """Hold what the next step needs."""

    map: VoxelMap
    window: tuple[Placed, ...]  # the oldest first
    before: GaussianBelief  # over the state of the oldest, in the window's frame
    drift: Float[np.ndarray, "p p"]  # of that frame in the world: the covariance of the oldest pose there
    earlier: tuple[Earlier, ...]
    belief: GaussianBelief  # over the newest state, as seen from the last accepted image
    last: ReferenceView  # the last accepted image, at tracking size
    lost: bool  # the last image was not accepted
    key: PRNGKeyArray
    measurement_noise: MeasurementNoise
    cost: float  # mean residual of the window, in standard deviations


@dataclass(frozen=True)
class OnlineSmoother:
    """Smooth the newest steps together (:class:`~vssm_gym.inference.filter.Filter`), from nothing (eq. I60).

    Attributes:
        rig: the camera and its pose on the body.
        transition: how the body moves.
        config: window and effort.
    """

    rig: Rig
    transition: Transition
    config: OnlineConfig = OnlineConfig()

    def init(self, prior: Posterior, image: RGBD, key: PRNGKeyArray) -> OnlineState:
        """Return the state after the first image, taken where the prior has the body; the map is consumed.

        Raises:
            InputError: no map in the prior, no Gaussian belief, or an image without depth.
        """
        if prior.map is None:
            raise InputError("smoother.init", "prior", "a map: an empty one to begin with")
        if not readable(image, self.config.tracking):
            expected = f"depth at {self.config.tracking.min_reading:.0%} of its pixels at least"
            raise InputError("smoother.init", "image", expected)
        small, rig = shrunk(image, self.rig, self.config.track_width)
        belief = begin(prior.belief, small, rig).belief
        view = view_of(small, rig.camera, self.config.smoothing.align)
        step = Step(belief.mean, view, jnp.zeros(self.transition.controls), 0.0)
        first = Placed(step, image, np.asarray(belief.covariance, np.float64))
        drift, known = np.zeros((self._poses, self._poses)), self._seen_from_itself(first)
        last = reference_view.of_image(camera_pose(belief, rig), small)
        return OnlineState(
            prior.map, (first,), belief, drift, (), known, last, False, key, prior.measurement_noise, 0.0
        )

    def step(
        self, state: OnlineState, control: Float[Array, "m"], image: RGBD, dt: float, clock: Clock = untimed
    ) -> tuple[OnlineState, FilterInfo]:
        """Unlock one more time step: align its image to the last one, then smooth the window.

        Args:
            state: after the last image; its map is consumed.
            control: of the transition since then; zeros for a hand's constant velocity.
            image: the new one, at the camera's size.
            dt: seconds since the last one.
            clock: called with name and outcome of each stage, returns the outcome; for timing.

        Raises:
            InputError: ``dt`` is not above 0, or a control of another length than the transition's.
        """
        h, control, config = seconds(dt), checked(self.transition, control), self.config
        small, rig = shrunk(image, self.rig, config.track_width)
        key, drawing = jax.random.split(state.key)
        state, dropped = self._moved_on(replace(state, key=key))
        found, predicted, quality = clock(
            "track", _aligned(state.belief, self.transition, control, h, state.last, small, rig, config.tracking)
        )
        last = state.window[-1]
        unseen = replace(
            state,
            window=(*state.window, self._placed(predicted, without_image(rig.camera), None, control, dt, last)),
            belief=predicted,
            lost=True,
        )
        status = Status.LOST if readable(small, config.tracking) else Status.NO_READING
        view = view_of(small, rig.camera, config.smoothing.align)
        fits = float(quality.inlier_share) >= config.tracking.min_score
        if status is Status.NO_READING or not fits or not len(view.pixels):
            return unseen, FilterInfo(status, _newest(unseen), quality, dropped)
        newest = self._placed(found, view, image, control, dt, last)
        seen, share = clock("smooth", self._smoothed(replace(state, window=(*state.window, newest)), rig, drawing))
        if share < config.least_shared:
            return unseen, FilterInfo(status, _newest(unseen), quality, dropped)
        known = self._seen_from_itself(seen.window[-1])
        state = replace(seen, belief=known, last=reference_view.of_image(camera_pose(known, rig), small), lost=False)
        return state, FilterInfo(Status.OK, _newest(state), quality, dropped)

    def posterior(self, state: OnlineState) -> Posterior:
        """Return ``q(z_t)``, and ``q(M)`` of the images whose steps have left the window.

        Args:
            state: after an image.
        """
        return Posterior(_newest(state), state.map, state.measurement_noise)

    @property
    def _poses(self) -> int:
        """Return the number of a pose's coordinates."""
        return self.transition.manifold.twists.shape[1]

    def _moved_on(self, state: OnlineState) -> tuple[OnlineState, int]:
        """Make room for one more step: the oldest enters the map, and stays as an earlier image where it is new.

        Returns:
            The state, and how many blocks of the map its window lost.
        """
        if len(state.window) < self.config.free:
            return state, 0
        (oldest, second, *_), config, dropped = state.window, self.config, 0
        m, T = state.map, _camera(self.transition.manifold, oldest.step.state, self.rig.T_body_cam)
        if oldest.image is not None:
            m, dropped = rolling_window.followed(m, T[:3, 3], config.window_margin)
            m = map_update.update(m, oldest.image.depth, oldest.image.rgb, T, self.rig.camera, config.update)
        earlier, now = state.earlier, Earlier(oldest.step.view, np.asarray(T, np.float64))
        if len(now.view.pixels) and (not earlier or _apart(now, earlier[-1].T_world_cam) > config.spacing):
            earlier = (*earlier, now) if len(earlier) < config.most_kept else (*earlier[::2], now)
        p, covariance = self._poses, second.covariance.copy()
        drift = covariance[:p, :p].copy()
        covariance[:p], covariance[:, :p] = 0.0, 0.0
        covariance[:p, :p] = HELD_STD**2 * np.eye(p)
        before = replace(state.before, mean=second.step.state, covariance=jnp.asarray(covariance, jnp.float32))
        return replace(state, map=m, window=state.window[1:], before=before, drift=drift, earlier=earlier), dropped

    def _placed(
        self, belief: GaussianBelief, view: View, image: RGBD | None, control: Array, dt: float, last: Placed
    ) -> Placed:
        """Return a new step, whose belief does not count how the last step's pose errs in the world."""
        p = self._poses
        covariance = self._in_world(
            belief.mean, np.asarray(belief.covariance), last.step.state, last.covariance[:p, :p]
        )
        return Placed(Step(belief.mean, view, control, dt), image, covariance)

    def _smoothed(self, state: OnlineState, rig: Rig, key: PRNGKeyArray) -> tuple[OnlineState, float]:
        """Return the state with the window smoothed, and the share of the drawn elements that its newest image sees."""
        config, newest = self.config, state.window[-1].step.state
        T = np.asarray(_camera(self.transition.manifold, newest, rig.T_body_cam), np.float64)
        near = sorted(state.earlier, key=lambda one: _apart(one, T))[: config.held]
        found = smooth_window(
            np.random.default_rng(np.asarray(jax.random.key_data(key))),
            [placed.step for placed in state.window],
            config.free,
            [(one.view, one.T_world_cam) for one in near],
            config.held,
            rig,
            self.transition,
            state.before,
            config.smoothing,
        )
        window = tuple(
            placed._replace(
                step=placed.step._replace(state=mean),
                covariance=self._in_world(mean, covariance, found.states[0], state.drift),
            )
            for placed, mean, covariance in zip(state.window, found.states, found.covariance, strict=True)
        )
        return replace(state, window=window, cost=found.cost), found.shared

    def _in_world(self, mean: Any, covariance: np.ndarray, origin: Any, drift: np.ndarray) -> np.ndarray:
        """Return the covariance of a state about an origin whose own pose errs by ``drift``, which moves both alike."""
        p, manifold = self._poses, self.transition.manifold
        twists = np.asarray(manifold.twists, np.float64)
        between = inverse(np.asarray(manifold.pose(mean), np.float64)) @ np.asarray(manifold.pose(origin))
        carried = np.linalg.pinv(twists) @ np.asarray(se3_adjoint(jnp.asarray(between, jnp.float32))) @ twists
        wider = np.array(covariance, np.float64)
        wider[:p, :p] += carried @ drift @ carried.T
        return wider

    def _seen_from_itself(self, placed: Placed) -> GaussianBelief:
        """Return the belief of one who knows the pose at an image, and the rest of the state as well as it is known."""
        p, covariance = self._poses, placed.covariance.copy()
        covariance[:p], covariance[:, :p] = 0.0, 0.0
        return GaussianBelief(placed.step.state, jnp.asarray(covariance, jnp.float32), self.transition.manifold)


def _newest(state: OnlineState) -> GaussianBelief:
    """Return the belief over the newest state, in the world."""
    return replace(state.belief, covariance=jnp.asarray(state.window[-1].covariance, jnp.float32))


def _apart(one: Earlier, T_world_cam: Float[np.ndarray, "4 4"]) -> float:
    """Return how much two views differ, m: the distance, and the angle by which the camera turned."""
    R = one.T_world_cam[:3, :3].T @ T_world_cam[:3, :3]
    angle = np.arccos(np.clip(0.5 * (np.trace(R) - 1.0), -1.0, 1.0))
    return float(np.linalg.norm(one.T_world_cam[:3, 3] - T_world_cam[:3, 3]) + angle / SAME_VIEW_TURN)


@partial(jax.jit, static_argnums=7)
def _aligned(
    belief: GaussianBelief,
    transition: Transition,
    control: Array,
    dt: Array,
    last: ReferenceView,
    image: RGBD,
    rig: Rig,
    config: TrackingConfig,
) -> tuple[GaussianBelief, GaussianBelief, AlignInfo]:
    """Return the belief after the image is aligned to the last accepted one, and as predicted; and the fit's quality.

    Only the mean of the former is that of a posterior: what the window does not know stays as uncertain as predicted.
    """
    manifold = transition.manifold
    predicted = transition.predict(belief, control, dt)
    basis = camera_twists(manifold, rig)
    p = basis.shape[1]
    T_prior = inverse(last.T_world_cam) @ camera_pose(predicted, rig)
    begun = start_poses.first(T_prior, last, last.T_world_cam, last.image, image, rig.camera, config)
    precision = jnp.linalg.inv(predicted.covariance[:p, :p])
    T, quality = gauss_newton.align(
        T_prior, precision, begun.poses[0], basis, last.image, begun.image, rig.camera, config.align
    )
    moved = jnp.linalg.pinv(basis) @ se3_log(inverse(T_prior) @ T)
    mean = manifold.perturb(predicted.mean, predicted.covariance[:, :p] @ precision @ moved)
    return replace(predicted, mean=mean), predicted, quality


@partial(jax.jit, static_argnums=0)
def _camera(manifold: Manifold, state: Any, T_body_cam: Array) -> Float[Array, "4 4"]:
    return manifold.pose(state) @ T_body_cam
