"""Simulate a robot on the floor among an apartment's boxes in MuJoCo.

Each box of the apartment is in the model once as it is, for rays and pictures. Where the robot can collide with it, it
is there once more as an invisible upright prism for contacts: the robot then meets vertical faces only, so that no
table edge can press it into the floor. The robot is a sphere halfway up the prisms, whose contact with a prism is that
of the cylinder, in closed form.
"""

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.physics.boxes import (
    CONTACTS_GROUP,
    LOOKS_GROUP,
    ROBOT_GROUP,
    bearings,
    boxes_of_geoms,
    cast_rays,
    empty_spec,
    fixed_box,
)
from vssm_gym.envs.physics.planar import clearance, rectangles
from vssm_gym.envs.robots.base import Robot
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.envs.scenes.free_space import STEP_HEIGHT
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.transforms import wrap_angle

KEEP = 0.002  # m before an obstacle from which on contacts are simulated
SUBSTEP = 0.005  # m that the robot covers in a substep at most: contacts are found no deeper than this


def obstacles(boxes: Sequence[SolidBox], height: float) -> list[int]:
    """Return the indices of the boxes that a robot of this height can hit.

    Those that meet z in (STEP_HEIGHT, height).
    """
    return [
        i
        for i, box in enumerate(boxes)
        if box.center[2] + 0.5 * box.size[2] > STEP_HEIGHT and box.center[2] - 0.5 * box.size[2] < height
    ]


def build_floor_spec(apartment: Apartment, robot: Robot) -> mujoco.MjSpec:
    """Build the model of the apartment's fixed boxes and the robot on joints ``(x, y, heading)``; SI units, z up.

    Geoms are named ``box I`` and ``prism I`` after the index in ``apartment.boxes()``; the body is named ``robot``.
    """
    boxes = apartment.boxes()
    spec = empty_spec(apartment.name)
    mid = 0.5 * robot.height
    for i, box in enumerate(boxes):
        fixed_box(spec, f"box {i}", box, group=LOOKS_GROUP, rgba=[*box.material.color, 1.0])
    for i in obstacles(boxes, robot.height):
        prism = fixed_box(spec, f"prism {i}", boxes[i], group=CONTACTS_GROUP, rgba=[1.0, 0.0, 0.0, 0.2])
        prism.pos[2], prism.size[2] = mid, mid + 1.0
        prism.contype, prism.conaffinity = 1, 1

    body = spec.worldbody.add_body(name="robot")
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    body.add_joint(name="x", type=slide, axis=[1, 0, 0])
    body.add_joint(name="y", type=slide, axis=[0, 1, 0])
    body.add_joint(name="heading", type=hinge, axis=[0, 0, 1])
    body.add_geom(
        name="body",
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=[robot.radius, mid, 0.0],
        pos=[0.0, 0.0, mid],
        contype=0,
        conaffinity=0,
        group=ROBOT_GROUP,
        rgba=[0.9, 0.5, 0.1, 1.0],
    )
    body.add_geom(
        name="disc",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[robot.radius, 0.0, 0.0],
        pos=[0.0, 0.0, mid],
        contype=1,
        conaffinity=1,
        priority=1,  # the disc's contact parameters alone count, not a mixture with the prisms'
        condim=1,  # frictionless: the robot slides along obstacles
        solref=[1e-4, 1.0],  # as stiff as the substep allows: MuJoCo raises the time constant to two substeps
        group=CONTACTS_GROUP,
        mass=1.0,
        rgba=[1.0, 0.0, 0.0, 0.2],
    )
    return spec


class FloorWorld:
    """Simulate the robot among the apartment's boxes; one object is one simulation, for one thread."""

    reads_contacts = True  # keep contacts for :meth:`contact_bearings`: a quarter of the time of a step in contact

    def __init__(self, apartment: Apartment, robot: Robot) -> None:
        self.apartment, self.robot = apartment, robot
        self._build()

    def _build(self) -> None:
        self.boxes = self.apartment.boxes()
        self.model = build_floor_spec(self.apartment, self.robot).compile()
        self.data = mujoco.MjData(self.model)
        self._box_of_geom = boxes_of_geoms(self.model)
        self._body = self.model.body("robot").id
        self._rectangles = rectangles([self.boxes[i] for i in obstacles(self.boxes, self.robot.height)])
        self._collided: set[int] = set()
        self._contacts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # a substep's geoms, normals, heading
        mujoco.mj_forward(self.model, self.data)

    def __getstate__(self) -> dict[str, Any]:
        state = {
            "apartment": self.apartment,
            "robot": self.robot,
            "planar": self.pose(),
            "reads_contacts": self.reads_contacts,
        }
        return state | {"collided": self._collided, "contacts": self._contacts}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.apartment, self.robot, self.reads_contacts = state["apartment"], state["robot"], state["reads_contacts"]
        self._build()
        self.reset(state["planar"])
        self._collided, self._contacts = state["collided"], state["contacts"]

    def reset(self, planar: PlanarPose) -> None:
        """Place the robot at ``(x, y, heading)``, m and rad, at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = planar
        mujoco.mj_kinematics(self.model, self.data)  # rays need the geoms' places
        self._collided, self._contacts = set(), []

    def pose(self) -> PlanarPose:
        """Return the robot's ``(x, y, heading)``, m and rad, heading in [-pi, pi); float64 ``(3,)``."""
        x, y, heading = self.data.qpos
        return np.array([x, y, wrap_angle(heading)])

    def drive(self, target: PlanarPose) -> bool:
        """Move towards ``target = (x, y, heading)`` for ``robot.dt`` seconds at constant speed, by the shorter turn.

        In free space the robot ends at the target; obstacles stop it or make it slide along them. Physics is simulated
        only from where an obstacle can be in the way, by the exact distance to the nearest one.

        Returns:
            True on collision (:meth:`contacts` names the obstacles).
        """
        model, data = self.model, self.data
        displacement = np.asarray(target, dtype=np.float64) - data.qpos
        displacement[2] = wrap_angle(displacement[2])
        self._collided, self._contacts = set(), []
        travel = math.hypot(displacement[0], displacement[1])
        free = clearance(data.qpos[0], data.qpos[1], self._rectangles) - self.robot.radius - KEEP
        if free > 0.0 and travel <= free:
            data.qpos[:] += displacement
            return False
        velocity = displacement / self.robot.dt
        ahead = max(0.0, free) / travel if travel > 0.0 else 0.0
        data.qpos[:] += ahead * displacement
        substeps = max(1, math.ceil((1.0 - ahead) * travel / SUBSTEP))
        model.opt.timestep = (1.0 - ahead) * self.robot.dt / substeps
        qvel, step = data.qvel, mujoco.mj_step
        pairs = set()  # of geoms in contact, a substep's as bytes: sliding along a wall they are the same ones
        for _ in range(substeps):
            qvel[:] = velocity  # the drive restores the speed after each contact
            step(model, data)
            if data.ncon:
                met = data.contact.geom
                pairs.add(met.tobytes())
                if self.reads_contacts:
                    # Copied: the arrays are views of memory that the next substep reuses. Contacts are those of the
                    # substep's begin, and so is the body's pose; qpos is that of its end.
                    normals = data.contact.frame[:, :3].copy()
                    self._contacts.append((met.copy(), normals, data.xmat[self._body].copy()))
        geoms = np.frombuffer(b"".join(pairs), dtype=np.int32)
        self._collided = set(self._box_of_geom[geoms].tolist()) - {-1}
        return bool(self._collided)

    def contacts(self) -> list[str]:
        """Return the names of the obstacles hit in the last :meth:`drive`, in the order of the apartment's boxes."""
        return list(dict.fromkeys(self.boxes[i].name for i in sorted(self._collided)))

    def contact_bearings(self) -> Float[np.ndarray, "n"]:
        """Return the directions of the obstacles in contact during the last :meth:`drive`, rad, from body x.

        There is one direction for each contact and substep, counter-clockwise, from the robot to the obstacle, against
        the contact's normal.
        """
        met = [bearings(self._box_of_geom[geoms], normals, R) for geoms, normals, R in self._contacts]
        return np.concatenate(met) if met else np.zeros(0)

    def multi_ray(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the first box along each ray ``origin + t direction``; see :func:`cast_rays`."""
        return cast_rays(self.model, self.data, self._box_of_geom, origin, directions)
