"""Define what a spatial world model has to offer to be scored: ``p(x_t+h, z_t+h | x_<=t, u_<t+h)``.

A model that can only draw samples of images and poses returns a
:class:`~vssm_gym.eval.bench.prediction.mixture.SampledPrediction` of them.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.agents.base import AgentContext
from vssm_gym.geometry.camera import Camera
from vssm_gym.model.emission import RGBD
from vssm_gym.model.emission_density import ImageLogProb


@runtime_checkable
class ImagePrediction(Protocol):
    """Describe the predictive distribution of one image, pixel by pixel.

    A pixel has no reading, or a depth in ``(0, MAX_DEPTH]`` m and a colour in ``[0, 1]^3``.
    """

    def image_log_prob(self, image: RGBD) -> ImageLogProb:
        """Return the log density of each pixel, nats: of the reading or its absence, and of colour given a reading."""

    def depth_cdf(self, depth: Float[Array, "*batch height width"]) -> Float[Array, "*batch height width"]:
        """Return the probability of a depth of at most this, given a reading, by pixel."""

    def rgb_cdf(self, rgb: Float[Array, "*batch height width 3"]) -> Float[Array, "*batch height width 3"]:
        """Return the probability of a channel of at most this, given a reading, by pixel and channel."""


@runtime_checkable
class Prediction(ImagePrediction, Protocol):
    """Describe the predictive distribution of one image, and of the pose from which it is taken."""

    @property
    def poses(self) -> Float[Array, "samples 3"]:
        """Return samples of the pose, ``(x, y, heading)`` in the world, m and rad; a hundred at least."""

    def pose_log_prob(self, planar: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the log density of a pose, with respect to metres along both axes times the angle in rad."""


@runtime_checkable
class WorldModel(Protocol):
    """Describe a model that follows a robot and predicts what its camera will see."""

    @property
    def name(self) -> str:
        """Return the label of its rows."""

    def begin(self, context: AgentContext, image: RGBD) -> None:
        """Start a drive at ``context.start_pose``, with the learned map ``context.map``, and see the first image."""

    def observe(self, command: np.ndarray, image: RGBD) -> None:
        """Take the image that followed a command of the robot."""

    def predict(self, commands: Float[np.ndarray, "steps m"], camera: Camera, key: PRNGKeyArray) -> Prediction:
        """Predict the image and the pose after some more commands.

        Args:
            commands: from now on, one a step of ``context.dt`` seconds.
            camera: that the image is taken with: the robot's own, with every n-th of its pixels.
            key: of the random numbers.
        """
