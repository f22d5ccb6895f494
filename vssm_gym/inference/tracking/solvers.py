"""List the solvers that align an image to a reference view."""

from typing import NamedTuple, Protocol

from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.geometry.camera import Camera
from vssm_gym.inference.alignment import gauss_newton
from vssm_gym.inference.alignment.adam import AdamConfig, align_adam
from vssm_gym.inference.alignment.reference_view import ReferenceView
from vssm_gym.inference.alignment.residuals import AlignConfig, AlignInfo
from vssm_gym.model.emission import RGBD


class Problem(NamedTuple):
    """Hold an image and what it is aligned to."""

    T_prior: Float[Array, "4 4"]  # T_ref_cam, predicted
    basis: Float[Array, "6 p"]  # the twists (camera frame) along which the camera may move
    reference: ReferenceView
    image: RGBD  # at the reference's exposure
    camera: Camera


class Solver(Protocol):
    """Return T_ref_cam that minimises the alignment's cost plus the prior's, and how well it fits."""

    def __call__(
        self,
        problem: Problem,
        precision: Float[Array, "p p"],
        T_start: Float[Array, "4 4"],
        align: AlignConfig,
        adam: AdamConfig,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, "4 4"], AlignInfo]:
        """Solve with a prior's precision, from a start pose."""
        ...


def _by_gauss_newton(
    problem: Problem, precision: Array, T_start: Array, align: AlignConfig, adam: AdamConfig, key: Array
) -> tuple[Array, AlignInfo]:
    T_prior, basis, reference, image, camera = problem
    return gauss_newton.align(
        T_prior, precision, T_start, basis, reference.image, image, camera, align, reference.seen, reference.spread
    )


def _by_adam(
    problem: Problem, precision: Array, T_start: Array, align: AlignConfig, adam: AdamConfig, key: Array
) -> tuple[Array, AlignInfo]:
    T_prior, basis, reference, image, camera = problem
    return align_adam(
        T_prior, precision, T_start, basis, reference.image, image, camera, align, key, adam, reference.spread
    )


SOLVERS: dict[str, Solver] = {"gauss_newton": _by_gauss_newton, "adam": _by_adam}
