"""Model what an IMU or a drive does wrong by a few constants: biases, drag and lever arm, or gains and offsets.

    IMU:    f = a - b_a - D R^T v - w x (w x l) - w' x l,    w = w_b - b_w,    then the step of :class:`Imu`
    drive:  u' = G u + c,    then the step of the robot

These are the parametric models that a learned transition is compared with, and whose step it may correct. The constants
come from a fit to recorded motion; all zero (and gains of one) is the uncalibrated model.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.imu import Imu
from vssm_gym.model.transition.manifold import PLANAR, RIGID, RigidState


class ImuConstants(eqx.Module):
    """Hold the constants of an IMU on a body, in the IMU's frame.

    Attributes:
        accel_bias: m/s^2, subtracted from the specific force.
        gyro_bias: rad/s, subtracted from the rate.
        drag: 1/s, of each axis: a deceleration that the accelerometer does not show.
        lever: m, from the body's origin to the IMU.
    """

    accel_bias: Float[Array, "3"]
    gyro_bias: Float[Array, "3"]
    drag: Float[Array, "3"]
    lever: Float[Array, "3"]

    @classmethod
    def zero(cls) -> "ImuConstants":
        """Return those of an ideal IMU at the body's origin."""
        return cls(jnp.zeros(3), jnp.zeros(3), jnp.zeros(3), jnp.zeros(3))


class CalibratedImu(Transition):
    """Integrate an IMU's readings, corrected by constants (eq. M34).

    States and controls are those of :class:`Imu`. The angular acceleration of the lever arm's term is the change of the
    rate since the last step, which the state holds.

    Attributes:
        constants: biases, drag and lever arm.
        imu: the step, with its noise.
    """

    constants: ImuConstants
    imu: Imu = Imu()

    manifold = RIGID
    controls = 6
    commanded = False

    def mean(self, state: RigidState, control: Float[Array, "*batch 6"], dt: float | Array) -> RigidState:
        """Correct force and rate, then integrate them."""
        return self.imu.mean(state, self._corrected(state, control, dt), dt)

    def noise_covariance(
        self, state: RigidState, control: Float[Array, "6"], dt: float | Array
    ) -> Float[Array, "12 12"]:
        """Return that of the IMU."""
        return self.imu.noise_covariance(state, control, dt)

    def _corrected(self, state: RigidState, control: Float[Array, "*batch 6"], dt: float | Array) -> Array:
        """Return specific force and rate of the body's origin."""
        known, R = self.constants, state.T_world_body[..., :3, :3]
        v, before = (jnp.einsum("...ji,...j->...i", R, state.velocity[..., k : k + 3]) for k in (0, 3))
        w = control[..., 3:6] - known.gyro_bias
        lever = jnp.broadcast_to(known.lever, w.shape)
        swing = jnp.cross(w, jnp.cross(w, lever)) + jnp.cross((w - before) / dt, lever)
        force = control[..., :3] - known.accel_bias - known.drag * v - swing
        return jnp.concatenate([force, w], axis=-1)


class CalibratedDrive(Transition):
    """Drive a robot or a car by commands that it executes with constant gains and offsets (eq. M34).

    Attributes:
        drive: the transition whose commands are corrected; its noise is used as it is.
        gain: ``(commands, commands)``.
        offset: in the units of the commands.
    """

    drive: Transition
    gain: Float[Array, "m m"]
    offset: Float[Array, "m"]

    manifold = PLANAR
    commanded = True

    @property
    def controls(self) -> int:  # type: ignore[override]
        """Return those of the drive."""
        return self.drive.controls

    def mean(
        self, state: Float[Array, "*batch 3"], control: Float[Array, "*batch m"], dt: float | Array
    ) -> Float[Array, "*batch 3"]:
        """Correct the command, then drive."""
        return self.drive.mean(state, control @ self.gain.T + self.offset, dt)

    def noise_covariance(
        self, state: Float[Array, "3"], control: Float[Array, "m"], dt: float | Array
    ) -> Float[Array, "3 3"]:
        """Return that of the drive under the corrected command."""
        return self.drive.noise_covariance(state, self.gain @ control + self.offset, dt)
