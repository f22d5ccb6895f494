"""Simulate a ball in flight among an apartment's boxes in MuJoCo."""

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.physics.boxes import LOOKS_GROUP, ROBOT_GROUP, boxes_of_geoms, cast_rays, empty_spec, fixed_box
from vssm_gym.envs.scenes.apartment import Apartment


def build_flight_spec(apartment: Apartment, radius: float) -> mujoco.MjSpec:
    """Build the model of the apartment's solid boxes and a ball on three slides ``(x, y, z)``; SI units, z up.

    The ball does not turn: its contacts are frictionless, so a rotation would have no effect.
    """
    spec = empty_spec(apartment.name)
    for i, box in enumerate(apartment.boxes()):
        geom = fixed_box(spec, f"box {i}", box, group=LOOKS_GROUP, rgba=[*box.material.color, 1.0])
        geom.contype, geom.conaffinity = 1, 1
    body = spec.worldbody.add_body(name="robot")
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    body.add_geom(
        name="body",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[radius, 0.0, 0.0],
        contype=1,
        conaffinity=1,
        priority=1,
        condim=1,  # as the robot's disc
        solref=[1e-4, 1.0],
        group=ROBOT_GROUP,
        mass=1.0,
        rgba=[0.9, 0.5, 0.1, 1.0],
    )
    return spec


class FlightWorld:
    """Simulate a ball in flight among the apartment's boxes; one object is one simulation, for one thread.

    The ball moves at a velocity that the caller sets. Rotors, weight and drag are the caller's part
    (:mod:`vssm_gym.envs.flight_body`). Boxes stop the ball without friction.
    """

    def __init__(self, apartment: Apartment, radius: float) -> None:
        self.apartment, self.radius = apartment, radius
        self._build()

    def _build(self) -> None:
        self.boxes = self.apartment.boxes()
        self.model = build_flight_spec(self.apartment, self.radius).compile()
        self.data = mujoco.MjData(self.model)
        self._box_of_geom = boxes_of_geoms(self.model)
        mujoco.mj_forward(self.model, self.data)

    def __getstate__(self) -> dict[str, Any]:
        return {"apartment": self.apartment, "radius": self.radius, "at": self.position()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.apartment, self.radius = state["apartment"], state["radius"]
        self._build()
        self.reset(state["at"])

    def reset(self, position: Float[np.ndarray, "3"]) -> None:
        """Place the ball's centre at ``position``, m, world frame, at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = position
        mujoco.mj_kinematics(self.model, self.data)  # rays need the geoms' places

    def position(self) -> Float[np.ndarray, "3"]:
        """Return the ball's centre, m, world frame; float64."""
        return self.data.qpos.copy()

    def move(self, velocity: Float[np.ndarray, "3"], seconds: float) -> bool:
        """Move at ``velocity`` (m/s, world frame) for a time in which the ball covers less than its radius.

        Returns:
            True on collision; :meth:`velocity` is then the velocity after the contact.
        """
        self.model.opt.timestep = seconds
        self.data.qvel[:] = velocity
        mujoco.mj_step(self.model, self.data)
        return bool(self.data.ncon)

    def velocity(self) -> Float[np.ndarray, "3"]:
        """Return the ball's velocity after the last :meth:`move`, m/s, world frame; float64."""
        return self.data.qvel.copy()

    def multi_ray(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first box along each ray ``origin + t direction``; see :func:`cast_rays`."""
        return cast_rays(self.model, self.data, self._box_of_geom, origin, directions)
