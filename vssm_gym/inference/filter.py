"""Define the interface of a filter: ``q_t-1(z) q_t-1(M) -> q_t(z) q_t(M)``, image by image."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment.residuals import AlignInfo
from vssm_gym.inference.status import Status
from vssm_gym.model.emission import RGBD
from vssm_gym.model.posterior import Posterior
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief

KNOWN_START_STD = 1e-3  # m, rad, of the start of a robot that knows it

Clock = Callable[[str, Any], Any]  # called with name and outcome of each stage, returns the outcome; for timing


def untimed(stage: str, outcome: Any) -> Any:
    """Return the outcome of a stage: the default clock, which measures nothing."""
    return outcome


class Rig(eqx.Module):
    """Hold a camera and its pose on the body that the transition moves.

    Attributes:
        camera: intrinsics and image size.
        T_body_cam: pose of the camera in the body frame, m.
    """

    camera: Camera
    T_body_cam: Float[Array, "4 4"]

    @classmethod
    def of(cls, camera: Camera, T_body_cam: Any = None) -> "Rig":
        """Return the rig of a camera; by default the camera is the body.

        Args:
            camera: intrinsics and image size.
            T_body_cam: ``(4, 4)`` pose of the camera in the body frame, m; None: the camera is the body.

        Returns:
            The rig, its pose in float32.
        """
        T = jnp.eye(4) if T_body_cam is None else jnp.asarray(T_body_cam, jnp.float32)
        return cls(camera, T)


class FilterInfo(NamedTuple):
    """Report the outcome of a step."""

    status: Status
    belief: GaussianBelief  # in the world; the prediction where the image was not accepted
    fit_quality: AlignInfo | None = None  # fit quality of the alignment; None: nothing was aligned
    left_window: int = 0  # observed blocks that the map forgot, because the camera left its window


@runtime_checkable
class Filter(Protocol):
    """Define ``init``, called once, and ``step``, called once an image; static options and the transition are fields.

    The state holds only what the next step needs; a step consumes it. Controls are those of the transition.
    """

    @property
    def transition(self) -> Transition:
        """Return the transition that moves the body between images."""

    def init(self, prior: Posterior, image: RGBD, key: PRNGKeyArray) -> Any:
        """Return the state after the first image, taken where the prior's belief has the body; consumes its map.

        Raises:
            InputError: an unusable image or prior.
        """

    def step(
        self, state: Any, control: Float[Array, "m"], image: RGBD, dt: float, clock: Clock = untimed
    ) -> tuple[Any, FilterInfo]:
        """Return the state after one more image, ``dt`` seconds later, and a report of the step (eq. I1).

        Raises:
            InputError: ``dt`` is not above 0.
        """

    def posterior(self, state: Any) -> Posterior:
        """Return ``q(z_t) q(M)``, the state in the map's frame; it shares the state's arrays."""
