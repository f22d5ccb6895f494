"""Judge whether a pose estimate may be believed, and rule what a robot without one does.

Every agent that estimates its pose reads the same judgement (:class:`JudgedFilter`) and follows the same rule
(:class:`LostConfig`). The judgement uses what the robot has: its images, its commands, and what its filter reports.

    score >= min_score,   photometric <= clip(max_unexplained contrast / sigma, 1, max_photometric)

holds for an image that fits: its geometry does, and the mean photometric residual, in standard deviations ``sigma`` of
the alignment, is no larger than the image's own contrast. At a wrong place geometry may fit by chance, but not colours.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.agents.shared.frozen_images import FrozenConfig, FrozenImages, Liveness
from vssm_gym.agents.shared.overshoot import Overshoot, OvershootConfig
from vssm_gym.inference.alignment.residuals import AlignConfig, AlignInfo, score
from vssm_gym.inference.filter import Filter, FilterInfo
from vssm_gym.inference.relocalisation.relocaliser import Hypothesis, Outcome, Relocaliser
from vssm_gym.inference.status import Status
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition import GaussianBelief

Observation = Mapping[str, np.ndarray]


class Conduct(Enum):
    """Enumerate what a robot does with its pose estimate."""

    FOLLOW = "follow"  # it is believed
    COAST = "coast"  # drive on by the commands alone
    SEARCH = "search"  # turn in place, until an image fits
    WAIT = "wait"  # stand, because every motion adds an error that no image corrects
    GIVE_UP = "give up"


@dataclass(frozen=True)
class LostConfig:
    """Configure the rule for a robot whose estimate is not believed; in steps in a row."""

    coast: int = 10  # driven on by the commands alone
    give_up: int = 64  # two full turns of the holonomic robot

    def conduct(self, lost: int, status: Status) -> Conduct:
        """Return what to do after ``lost`` steps in a row without a believed estimate, the last with this status."""
        if lost > self.give_up:
            return Conduct.GIVE_UP
        if status is Status.FROZEN:
            return Conduct.WAIT
        if lost > self.coast or status is Status.REPEATED:  # a turn shows whether the camera is frozen
            return Conduct.SEARCH
        return Conduct.COAST if lost else Conduct.FOLLOW


def gave_up(lost: int) -> str:
    """Return the activity of an agent that ends its task because it was lost for so many steps."""
    return f"gave up: lost for {lost} steps"


@dataclass(frozen=True)
class TrustConfig:
    """Configure which estimates are believed."""

    frozen: FrozenConfig = field(default_factory=FrozenConfig)
    overshoot: OvershootConfig = field(default_factory=OvershootConfig)
    min_reading: float = 0.05  # share of the pixels with depth: fewer fit anywhere
    min_score: float = 0.65  # of the alignment: 0.68 and more at the right place
    # Of the contrast. At the right place 0.1 to 0.7 of exact images and up to 1 of a Kinect's, whose exposure changes.
    max_unexplained: float = 1.0
    max_photometric: float = 4.0
    # m and rad: std of the motion that no image showed, beyond which a chain of images is broken
    most_unseen: tuple[float, float] = (0.1, 0.06)
    confirm: int = 3  # images in a row that fit, after which a robot that was lost believes its estimate again
    relocalise: int = 3  # steps lost in a row, after which each image is compared with all of a known map


TRUST = TrustConfig()


@dataclass(frozen=True)
class Judged:
    """Hold an estimate and its judgement.

    Attributes:
        belief: over the planar pose, in the map's frame.
        in_world: the same in the world, with the drift of a map that the filter builds.
        status: of the last step.
        lost: steps in a row without an estimate that may be believed; 0 where it may.
    """

    belief: GaussianBelief
    in_world: GaussianBelief
    status: Status
    lost: int


class JudgedFilter:
    """Run a filter on a robot's images, and judge each of its estimates.

    While images are frozen the filter gets none, and its belief follows the commands. A filter that compares an image
    with the one before cannot tell where the robot is once two of them do not fit, or once it has moved too far without
    an image (``TrustConfig.most_unseen``): it is never believed again. In a known map a lost filter starts anew where
    its images are found in all of the map, and is believed after as many fits there as any lost one. Until then the
    estimate follows the commands from the last one, and stays with it where an image does not fit at the new place.

    Args:
        filter: of the pose; its controls are the robot's commands.
        state: of the filter after the first image.
        dt: length of a step, s.
        observation: with the first image.
        chained: True for a filter that compares images with each other alone.
        config: which estimates are believed.
        relocaliser: returns that of the filter's map, called once the robot is lost; None: it waits for a fit.
    """

    def __init__(
        self,
        filter: Filter,
        state: Any,
        dt: float,
        observation: Observation,
        chained: bool = False,
        config: TrustConfig = TRUST,
        relocaliser: Callable[[], Relocaliser] | None = None,
    ) -> None:
        self._filter, self._dt, self._config, self._chained = filter, dt, config, chained
        self.state = state
        self._in_world = self._belief()  # of the filter's last step
        self._images = FrozenImages(filter.transition, dt, config.frozen)
        self._images.reset(observation)
        self._overshoot = Overshoot(filter.transition, dt, config.overshoot)
        self._dark = RGBD.from_camera(*(np.zeros_like(observation[name]) for name in ("rgb", "depth")))
        self._denied: list[np.ndarray] = []  # commands that the belief does not follow, because an image repeated
        self._lost = self._fits = 0
        self._relocaliser = relocaliser
        self._hypotheses: tuple[Hypothesis, ...] = ()  # places that explain the images since the robot was lost alike
        # The state before the filter started anew, moved on by the commands, until the new place is confirmed.
        self._left: Any = None
        self._broken = False  # the chain of images
        self._unseen = np.zeros(2)  # variances of the motion that no image showed, m^2 and rad^2

    def step(self, command: np.ndarray, observation: Observation) -> Judged:
        """Return the estimate after ``command``, which ``observation`` followed."""
        liveness, followed = self._images.update(command, observation), False
        if liveness is Liveness.LIVE:
            status, followed = self._see(command, observation)
            if self._left is not None and not status.accepted:
                self._return()
                status, followed = self._see(command, observation)
        else:
            status = Status.FROZEN if liveness is Liveness.FROZEN else Status.REPEATED
        self._follow(command)
        if liveness is Liveness.LIVE and self._is_found(status, command, observation):
            status, followed, self._fits = Status.RECOVERED, False, 0  # fits at other places count for nothing
        if not self._images.repeats:
            self._denied = []
        elif not followed:  # a repeated image that was accepted shows no motion
            self._denied = [*self._denied, command]
        if liveness is Liveness.FROZEN:
            for denied in self._denied:
                self._count_unseen(self._mean(), denied)
                self._advance(denied, self._dark)
            self._denied = []
        self._fits = self._fits + 1 if status.accepted else 0
        confirmed = self._lost == 0 or self._fits >= self._config.confirm
        believed = status.accepted and confirmed and not self._broken
        self._lost = 0 if believed else self._lost + 1
        self._left = None if believed else self._left
        status = Status.UNCONFIRMED if status.accepted and not believed else status
        if self._left is not None:
            left = self._belief(self._left)
            return Judged(left, left, status, self._lost)
        return Judged(self._belief(), self._in_world, status, self._lost)

    def _see(self, command: np.ndarray, observation: Observation) -> tuple[Status, bool]:
        """Advance the filter by a live image; return its judgement, and True where the command alone moved it."""
        before = self._mean()
        info = self._advance(command, RGBD.from_camera(observation["rgb"], observation["depth"]))
        status = self._status(info, observation)
        if status is Status.OK and self._overshoot.update(before, command, self._mean()):
            status = Status.OVERSHOOT
        elif status is Status.RECOVERED:
            self._overshoot.reset()
        # The filter may have accepted what is not believed: a chain has then taken a wrong step.
        self._broken |= self._chained and status in (Status.LOST, Status.OVERSHOOT)
        followed = not info.status.accepted  # without an image, a belief follows the command
        if followed:
            self._count_unseen(before, command)
        return status, followed

    def _return(self) -> None:
        """Go on from the state that was left, which has followed all commands but the present one."""
        self.state, self._left, self._denied, self._fits = self._left, None, [], 0
        self._overshoot.reset()

    def _is_found(self, status: Status, command: np.ndarray, observation: Observation) -> bool:
        """Compare the image of a lost robot with all of the map; return True where the filter starts anew there."""
        early = self._lost < self._config.relocalise or self._images.repeats > 0
        if status.accepted or self._relocaliser is None or early:
            self._hypotheses = ()
            return False
        relocaliser, image = self._relocaliser(), RGBD.from_camera(observation["rgb"], observation["depth"])
        if self._hypotheses:
            found = relocaliser.narrowed(self._hypotheses, command, self._filter.transition, self._dt, image)
        if not self._hypotheses or found.outcome is Outcome.NOTHING:
            found = relocaliser.find(image)
        # A single place whose pose the image does not fix is looked for again, in all of the map.
        self._hypotheses = found.hypotheses if len(found.hypotheses) > 1 else ()
        if found.belief is None:
            return False
        self._left = self.state
        self.state = self._filter.init(Posterior(found.belief, relocaliser.map), image, jax.random.key(0))
        self._in_world = found.belief
        self._overshoot.reset()
        return True

    def _advance(self, command: np.ndarray, image: RGBD) -> FilterInfo:
        self.state, info = self._filter.step(self.state, jnp.asarray(command, jnp.float32), image, self._dt)
        self._in_world = info.belief
        return info

    def _follow(self, command: np.ndarray) -> None:
        """Move the state that was left on by a command."""
        if self._left is not None:
            control = jnp.asarray(command, jnp.float32)
            self._left, _ = self._filter.step(self._left, control, self._dark, self._dt)

    def _belief(self, state: Any = None) -> GaussianBelief:
        """Return the belief of a state, by default of the present one, in the map's frame."""
        belief = self._filter.posterior(self.state if state is None else state).belief
        assert isinstance(belief, GaussianBelief)
        return belief

    def _mean(self) -> Any:
        return self._belief().mean

    def _count_unseen(self, before: Any, command: np.ndarray) -> None:
        """Add the noise of a command whose motion no image shows; break the chain where that is too much."""
        manifold, control = self._filter.transition.manifold, jnp.asarray(command, jnp.float32)
        p = manifold.twists.shape[1]
        variances = np.diag(self._filter.transition.noise_covariance(before, control, self._dt))[:p]
        turns = manifold.turns[:p]
        if np.any(command):
            self._unseen += (variances[~turns].sum(), variances[turns].sum())
        self._broken |= self._chained and bool(np.any(self._unseen > np.square(self._config.most_unseen)))

    def _status(self, info: FilterInfo, observation: Observation) -> Status:
        """Judge an image that is not frozen, and its alignment."""
        depth = observation["depth"]
        if float(np.mean(np.isfinite(depth) & (depth > 0.0))) < self._config.min_reading:
            return info.status if info.status is Status.TURNED else Status.NO_READING
        if info.status.accepted and info.fit_quality is not None and not self._fits_well(info.fit_quality, observation):
            return Status.LOST
        return info.status

    def _fits_well(self, quality: AlignInfo, observation: Observation) -> bool:
        """Return True where geometry fits, and the residual of the colours does not exceed the image's contrast."""
        grey = np.asarray(observation["rgb"], np.float32).mean(axis=-1) / 255.0
        contrast = float(np.abs(grey - grey.mean()).mean()) / AlignConfig.rgb_sigma
        limit = np.clip(self._config.max_unexplained * contrast, 1.0, self._config.max_photometric)
        return float(score(quality)) >= self._config.min_score and float(quality.photometric) <= limit
