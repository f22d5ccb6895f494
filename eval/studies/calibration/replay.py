"""Run a robot's filter on a recorded drive, as its agent does, and compare what it states with the truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from vssm_gym.agents.base import AgentContext
from vssm_gym.agents.shared.localization import start_filter
from vssm_gym.eval.metrics.pose_calibration import planar_residuals
from vssm_gym.eval.studies.calibration.errors import FilterErrors, RunErrors
from vssm_gym.inference.registry import FILTERS
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.emission import RGBD
from vssm_gym.slam.calibration import segments

MapOf = Callable[[AgentContext], VoxelMap | None]  # the map of a filter that starts with this context


@dataclass(frozen=True)
class Drive:
    """Hold a drive of a robot on the floor.

    Attributes:
        context: what the robot knows at the start.
        images: ``rgb`` uint8 and ``depth`` (m) of every frame.
        commands: that led from each frame to the next.
        planar: true ``(x, y, heading)`` at every frame, m and rad.
        contacts: True for a step in which the robot met an obstacle.
    """

    context: AgentContext
    images: tuple[tuple[np.ndarray, np.ndarray], ...]
    commands: Float[np.ndarray, "steps m"]
    planar: Float[np.ndarray, "frames 3"]
    contacts: Bool[np.ndarray, "steps"]

    def part(self, frames: slice) -> "Drive":
        """Return the drive of these frames alone: the robot knows the true pose of the first."""
        steps = slice(frames.start, frames.stop - 1)
        return Drive(
            replace(self.context, start_pose=self.planar[frames.start]),
            self.images[frames],
            self.commands[steps],
            self.planar[frames],
            self.contacts[steps],
        )

    def segments(self, seconds: float) -> list["Drive"]:
        """Return the consecutive parts of a length; no two share a frame or a command."""
        times = self.context.dt * np.arange(len(self.planar))
        return [self.part(frames) for frames in segments(times, seconds)]


def measure(drive: Drive, name: str, map_of: MapOf, seconds: float, only_contacts: bool = False) -> RunErrors:
    """Run a filter over a drive, and anew over each of its segments.

    Args:
        drive: images, commands and truth.
        name: of the filter, in :data:`vssm_gym.inference.registry.FILTERS`.
        map_of: returns the map that a filter starts with.
        seconds: length of a segment.
        only_contacts: leave out segments without a contact.
    """
    parts = [part for part in drive.segments(seconds) if part.contacts.any() or not only_contacts]
    ends = tuple(errors_of(part, name, map_of).last_nees for part in parts)
    return RunErrors(errors_of(drive, name, map_of), ends)


def errors_of(drive: Drive, name: str, map_of: MapOf) -> FilterErrors:
    """Run a filter over a drive from its first frame, and return the errors of its beliefs in the world."""
    context, blind = drive.context, FILTERS[name].blind

    def image(frame: int) -> RGBD | None:
        return None if blind else RGBD.from_camera(*drive.images[frame])

    made, state = start_filter(name, context, image(0), map_of(context))
    means, covariances, accepted = [], [], []
    for step, command in enumerate(drive.commands):
        control = jnp.asarray(command, jnp.float32)
        state, info = made.step(state, control, image(step + 1), context.dt)  # type: ignore[arg-type]
        means.append(info.belief.mean)
        covariances.append(info.belief.covariance)
        accepted.append(info.status.accepted)
    mean, covariance = jax.device_get((means, covariances))
    kept = np.array(accepted)
    return FilterErrors(
        residuals=planar_residuals(np.asarray(mean)[kept], drive.planar[1:][kept]),
        covariances=np.asarray(covariance, np.float64)[kept],
        frames=len(kept),
        lost=int(np.count_nonzero(~kept)),
        ended=bool(kept[-1]),
    )
