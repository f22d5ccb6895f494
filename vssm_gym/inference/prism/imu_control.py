"""Convert IMU readings to controls of PRISM's rigid body: the camera's acceleration between two images.

    a_world = R mean(R_k f_k) + g,    w_world = R log(prod_k exp(w_k h_k)) / dt,    u = (a_world, (w_world - w) / dt)

``R_k`` is the rotation since the first image, integrated from the gyroscope. The body is taken to be at rest during the
first ``REST_SECONDS``: the mean force is ``-g`` in the first camera's frame, which is the world's, and the mean rate is
the gyroscope's bias. An error in gravity has little effect: the filter corrects velocities at every image.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4

REST_SECONDS = 0.5  # s
MOVING_STD = 0.5  # m/s^2 and rad/s: a larger std of the first readings means that the body was not at rest


class ImuControl:
    """Compute controls between images of a camera fixed to an IMU (the lever arm between them is neglected).

    Args:
        readings: ``(n, 7)`` time (s), rate (rad/s) and specific force (m/s^2) in the body's frame, in order of time;
            each is the mean over the time since the previous one.
        T_body_cam: the camera's pose on the body.
        start: s, stamp of the first image, whose frame is the world.
    """

    def __init__(self, readings: Float[np.ndarray, "n 7"], T_body_cam: Matrix4, start: float) -> None:
        self._times, self._rates, self._forces = readings[:, 0], readings[:, 1:4], readings[:, 4:7]
        self._R_cam_body = np.asarray(T_body_cam, dtype=np.float64)[:3, :3].T
        rest = (self._times > start - REST_SECONDS) & (self._times <= start + REST_SECONDS)
        if rest.sum() < 3:
            raise InputError("imu", "times", f"readings within {REST_SECONDS} s of the first image; found {rest.sum()}")
        spread = max(self._rates[rest].std(axis=0).max(), self._forces[rest].std(axis=0).max())
        if spread > MOVING_STD:
            raise InputError(
                "imu", "readings", f"a body at rest in the first {REST_SECONDS} s; they spread by {spread:.2f}"
            )
        self.gyro_bias = self._rates[rest].mean(axis=0)
        self.gravity = -self._R_cam_body @ self._forces[rest].mean(axis=0)  # m/s^2, world

    def __call__(
        self, T_world_cam: Matrix4, rate: Float[np.ndarray, "3"], before: float, now: float
    ) -> Float[np.ndarray, "6"]:
        """Return linear (m/s^2) and angular (rad/s^2) acceleration, world; zero (constant velocity) without a reading.

        Args:
            T_world_cam: the pose at the last image.
            rate: angular velocity that the filter believed then, world, rad/s.
            before: s, stamp of the last image.
            now: s, that of the new one.
        """
        first, last = np.searchsorted(self._times, [before, now], side="right")
        if first == last:
            return np.zeros(6)
        h = np.diff(np.clip(self._times[first:last], before, now), prepend=before)
        R_world_body = np.asarray(T_world_cam, dtype=np.float64)[:3, :3] @ self._R_cam_body
        turns = Rotation.from_rotvec((self._rates[first:last] - self.gyro_bias) * h[:, None])
        turned, force = Rotation.identity(), np.zeros(3)
        for turn, f, seconds in zip(turns, self._forces[first:last], h, strict=True):
            force += (turned * turn**0.5).apply(f) * seconds
            turned = turned * turn
        covered = h.sum()
        linear = R_world_body @ force / covered + self.gravity
        angular = (R_world_body @ turned.as_rotvec() / covered - np.asarray(rate)) / (now - before)
        return np.concatenate([linear, angular])
