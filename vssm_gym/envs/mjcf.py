"""Physics: an apartment and a robot as a MuJoCo model, and the world that moves the robot through contacts.

This is the only module that imports MuJoCo, so it also compiles the models that people bring (:func:`static_geoms`).
Each box of the apartment appears once as it is, for rays and pictures,
and, where the robot could touch it, once more as an invisible upright prism for contacts: motion on the floor then
meets vertical faces only, so that no table edge can press the robot into the floor. The robot itself is a sphere
halfway up the prisms, whose contact with them is the cylinder's own, in closed form.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from vssm_gym.axes import PlanarPose
from vssm_gym.envs.apartment import Apartment
from vssm_gym.envs.free_space import STEP_HEIGHT
from vssm_gym.envs.robots import HolonomicRobot
from vssm_gym.envs.solids import SolidBox
from vssm_gym.errors import InputError
from vssm_gym.geometry import wrap_angle

SUBSTEP = 0.005  # m that the robot covers in a substep at most: contacts are found no deeper than this
_LOOKS, _ROBOT, _CONTACTS = 0, 2, 3  # MuJoCo's geom groups: real boxes, the robot's body, the invisible prisms


def obstacles(boxes: Sequence[SolidBox], height: float) -> list[int]:
    """Indices of the boxes that a robot of this height can touch: those that meet z in (STEP_HEIGHT, height)."""
    return [
        i
        for i, box in enumerate(boxes)
        if box.center[2] + 0.5 * box.size[2] > STEP_HEIGHT and box.center[2] - 0.5 * box.size[2] < height
    ]


def build_spec(apartment: Apartment, robot: HolonomicRobot) -> mujoco.MjSpec:
    """The apartment's boxes, fixed, and the robot on two slides and a hinge ``(x, y, heading)``; SI units, z up.

    Geoms are named ``box I`` and ``prism I`` after the index in ``apartment.boxes()``; the body is named ``robot``.
    """
    boxes = apartment.boxes()
    spec = mujoco.MjSpec()
    spec.modelname = apartment.name
    spec.option.gravity = [0.0, 0.0, 0.0]
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    mid = 0.5 * robot.height
    for i, box in enumerate(boxes):
        _fixed_box(spec, f"box {i}", box, group=_LOOKS, rgba=[*box.material.color, 1.0])
    for i in obstacles(boxes, robot.height):
        prism = _fixed_box(spec, f"prism {i}", boxes[i], group=_CONTACTS, rgba=[1.0, 0.0, 0.0, 0.2])
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
        group=_ROBOT,
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
        condim=1,  # frictionless: the robot slides along what it touches
        solref=[1e-4, 1.0],  # as stiff as the substep allows: MuJoCo raises the time constant to two substeps
        group=_CONTACTS,
        mass=1.0,
        rgba=[1.0, 0.0, 0.0, 0.2],
    )
    return spec


def _fixed_box(spec: mujoco.MjSpec, name: str, box: SolidBox, group: int, rgba: list[float]) -> Any:
    return spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=box.center,
        size=[0.5 * s for s in box.size],
        quat=[math.cos(0.5 * box.yaw), 0.0, 0.0, math.sin(0.5 * box.yaw)],
        contype=0,
        conaffinity=0,
        group=group,
        rgba=rgba,
    )


class World:
    """The robot among the apartment's boxes; one object is one simulation, for one thread."""

    def __init__(self, apartment: Apartment, robot: HolonomicRobot) -> None:
        self.apartment, self.robot = apartment, robot
        self._build()

    def _build(self) -> None:
        self.boxes = self.apartment.boxes()
        self.model = build_spec(self.apartment, self.robot).compile()
        self.data = mujoco.MjData(self.model)
        geoms = [self.model.geom(i).name.split() for i in range(self.model.ngeom)]
        # The box behind each geom; -1 for the robot's.
        self._box_of_geom = np.array([int(words[1]) if words[0] in ("box", "prism") else -1 for words in geoms])
        self._touched: set[int] = set()
        mujoco.mj_forward(self.model, self.data)

    def __getstate__(self) -> dict[str, Any]:
        return {"apartment": self.apartment, "robot": self.robot, "planar": self.pose(), "touched": self._touched}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.apartment, self.robot = state["apartment"], state["robot"]
        self._build()
        self.reset(state["planar"])
        self._touched = state["touched"]

    def reset(self, planar: PlanarPose) -> None:
        """Put the robot at ``(x, y, heading)``, m and rad, at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = planar
        mujoco.mj_kinematics(self.model, self.data)  # rays need the geoms' places
        self._touched = set()

    def pose(self) -> PlanarPose:
        """The robot's ``(x, y, heading)``, m and rad, heading in [-pi, pi); float64 ``(3,)``."""
        x, y, heading = self.data.qpos
        return np.array([x, y, wrap_angle(heading)])

    def drive(self, target: PlanarPose) -> bool:
        """Move towards ``target = (x, y, heading)`` for ``robot.dt`` seconds at constant speed, by the shorter turn.

        In free space the robot ends at the target; obstacles stop it or make it slide along them.

        Returns:
            Whether the robot touched an obstacle (:meth:`contacts` names them).
        """
        model, data = self.model, self.data
        displacement = np.asarray(target, dtype=np.float64) - data.qpos
        displacement[2] = wrap_angle(displacement[2])
        velocity = displacement / self.robot.dt
        substeps = max(1, math.ceil(math.hypot(displacement[0], displacement[1]) / SUBSTEP))
        model.opt.timestep = self.robot.dt / substeps
        self._touched = set()
        qvel, step = data.qvel, mujoco.mj_step
        for _ in range(substeps):
            qvel[:] = velocity  # the drive pushes on, whatever the last contact did to the speed
            step(model, data)
            if data.ncon:
                self._touched.update(self._box_of_geom[data.contact.geom].max(axis=1).tolist())
        return bool(self._touched)

    def contacts(self) -> list[str]:
        """Names of the obstacles that the last :meth:`drive` touched, in the order of the apartment's boxes."""
        return list(dict.fromkeys(self.boxes[i].name for i in sorted(self._touched)))

    def multi_ray(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First box along each ray ``origin + t direction`` (``mj_multiRay``); the robot itself is transparent.

        Args:
            origin: ``(3,)`` world frame, m.
            directions: ``(n, 3)`` world frame, any length.

        Returns:
            ``t`` float64 ``(n,)``, in multiples of the direction, 0 where nothing is hit; index of the box in
            ``apartment.boxes()``, int32 ``(n,)``, -1 where nothing is hit.
        """
        directions = np.asarray(directions, dtype=np.float64)
        norm = np.linalg.norm(directions, axis=-1)
        unit = np.ascontiguousarray(directions / norm[:, None]).reshape(-1)
        n = len(norm)
        geom, distance = np.full(n, -1, dtype=np.int32), np.zeros(n)
        groups = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
        groups[_LOOKS] = 1
        mujoco.mj_multiRay(
            self.model,
            self.data,
            np.asarray(origin, dtype=np.float64),
            unit,
            groups,
            True,
            -1,
            geom,
            distance,
            None,
            n,
            mujoco.mjMAXVAL,
        )
        box = np.where(geom >= 0, self._box_of_geom[geom], -1).astype(np.int32)
        return np.where(geom >= 0, distance / norm, 0.0), box


@dataclass(frozen=True)
class StaticGeom:
    """A geom of a compiled model at its initial pose, world frame, m.

    ``shape`` is MuJoCo's name ("plane", "box", "mesh", ...), ``size`` its three size parameters, ``rotation`` its axes
    in columns, ``collides`` whether MuJoCo lets anything touch it. ``vertices`` (n, 3) in the geom's frame and
    ``faces`` (m, 3) are a mesh's, empty for other shapes.
    """

    name: str
    shape: str
    center: np.ndarray
    rotation: np.ndarray
    size: np.ndarray
    rgba: np.ndarray
    collides: bool
    vertices: np.ndarray
    faces: np.ndarray


def static_geoms(xml: str, assets: Mapping[str, bytes], source: object) -> list[StaticGeom]:
    """The geoms of an MJCF text whose files are ``assets``; InputError where MuJoCo does not compile it."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)  # by default warnings go to a file in the working directory
    try:
        model = mujoco.MjModel.from_xml_string(xml, dict(assets))
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())
        raise InputError(source, "model", f"a model that MuJoCo compiles ({reason:.200})") from error
    finally:
        mujoco.set_mju_user_warning(handler)
    geoms = []
    for i in range(model.ngeom):
        geom, mesh, material = model.geom(i), int(model.geom_dataid[i]), int(model.geom_matid[i])
        vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
        if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH:
            first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            vertices = model.mesh_vert[first : first + count].astype(np.float64)
            first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            faces = model.mesh_face[first : first + count].copy()
        own = not np.allclose(model.geom_rgba[i], (0.5, 0.5, 0.5, 1.0))  # MuJoCo's rule: else the material's
        rgba = model.mat_rgba[material] if material >= 0 and not own else model.geom_rgba[i]
        name = geom.name or model.body(int(model.geom_bodyid[i])).name
        shape = mujoco.mjtGeom(int(model.geom_type[i])).name.removeprefix("mjGEOM_").lower()
        collides = bool(model.geom_contype[i] or model.geom_conaffinity[i])
        center, rotation = data.geom_xpos[i].copy(), data.geom_xmat[i].reshape(3, 3).copy()
        size = model.geom_size[i].copy()
        geoms.append(StaticGeom(name, shape, center, rotation, size, rgba.copy(), collides, vertices, faces))
    return geoms
