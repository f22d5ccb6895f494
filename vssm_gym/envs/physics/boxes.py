"""Put an apartment's boxes into a MuJoCo model, and cast rays at them."""

import math
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float, Int

from vssm_gym.envs.scenes.solids import SolidBox

# MuJoCo's geom groups: real boxes, the robot's body, the invisible prisms.
LOOKS_GROUP, ROBOT_GROUP, CONTACTS_GROUP = 0, 2, 3


def empty_spec(name: str) -> mujoco.MjSpec:
    """Return a model without gravity or sensors, whose contacts are solved by Newton's method."""
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.option.gravity = [0.0, 0.0, 0.0]
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    spec.option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    return spec


def fixed_box(spec: mujoco.MjSpec, name: str, box: SolidBox, group: int, rgba: list[float]) -> Any:
    """Add a static box without collisions and return its geom; set ``contype`` to let it collide."""
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


def boxes_of_geoms(model: mujoco.MjModel) -> np.ndarray:
    """Return the index of the box behind each geom of the model; -1 for the robot's geoms."""
    geoms = [model.geom(i).name.split() for i in range(model.ngeom)]
    return np.array([int(words[1]) if words[0] in ("box", "prism") else -1 for words in geoms])


def bearings(
    boxes: Int[np.ndarray, "n 2"], normals: Float[np.ndarray, "n 3"], R_world_body: np.ndarray
) -> Float[np.ndarray, "n"]:
    """Return the directions from a robot to the boxes in contact with it, rad, counter-clockwise from body x.

    Args:
        boxes: index of the box behind each of a contact's two geoms, -1 for the robot's.
        normals: normals of the contacts, from the first geom to the second, world frame.
        R_world_body: orientation of the robot, nine numbers.
    """
    outwards = np.where(boxes[:, 1:] >= 0, normals, -normals) @ R_world_body.reshape(3, 3)
    return np.arctan2(outwards[:, 1], outwards[:, 0])


def cast_rays(
    model: mujoco.MjModel, data: mujoco.MjData, box_of_geom: np.ndarray, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first box along each ray ``origin + t direction`` (``mj_multiRay``); the robot is transparent.

    Args:
        model: the simulation's model.
        data: the simulation's state.
        box_of_geom: index of the box behind each geom, -1 for the robot's.
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
    groups[LOOKS_GROUP] = 1
    mujoco.mj_multiRay(
        model,
        data,
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
    box = np.where(geom >= 0, box_of_geom[geom], -1).astype(np.int32)
    return np.where(geom >= 0, distance / norm, 0.0), box
