"""The contract of a filter: ``q_t-1(z) q_t-1(M) -> q_t(z) q_t(M)``, one image after the other."""

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

Clock = Callable[[str, Any], Any]  # given the name and the outcome of each stage, returns the outcome; for timing


def untimed(stage: str, outcome: Any) -> Any:
    """Return the outcome of a stage: the clock of those who do not ask."""
    return outcome


class Rig(eqx.Module):
    """A camera and its place on the body that the transition moves."""

    camera: Camera
    T_body_cam: Float[Array, "4 4"]

    @classmethod
    def of(cls, camera: Camera, T_body_cam: Any = None) -> "Rig":
        """Return the rig of a camera; by default the camera is the body."""
        T = jnp.eye(4) if T_body_cam is None else jnp.asarray(T_body_cam, jnp.float32)
        return cls(camera, T)


class FilterInfo(NamedTuple):
    """How a step went."""

    status: Status
    belief: GaussianBelief  # in the world; where the image does not fit, what is believed without it
    agreement: AlignInfo | None = None  # how well the image fits what it was aligned to; None: nothing was aligned
    left_window: int = 0  # observed blocks that the map forgot, because the camera left its window


@runtime_checkable
class Filter(Protocol):
    """``init``, then ``step`` once an image; static options and the transition are inside.

    The state holds only what the next step needs; a step consumes it. Controls are those of the transition.
    """

    @property
    def transition(self) -> Transition:
        """What moves the body between images."""

    def init(self, prior: Posterior, image: RGBD, key: PRNGKeyArray) -> Any:
        """Return the state after the first image, taken where the prior's belief has the body; consumes its map.

        Raises:
            InputError: an image or a prior that nothing can be started with.
        """

    def step(
        self, state: Any, control: Float[Array, "m"], image: RGBD, dt: float, clock: Clock = untimed
    ) -> tuple[Any, FilterInfo]:
        """Return the state after one more image, ``dt`` seconds later, and how the step went.

        Raises:
            InputError: ``dt`` is not above 0.
        """

    def posterior(self, state: Any) -> Posterior:
        """Return ``q(z_t) q(M)``, the state against the map; it shares the state's arrays."""
