"""Read the geoms of an imported MJCF model at their initial poses, as MuJoCo compiles them."""

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from vssm_gym.errors import InputError


@dataclass(frozen=True)
class StaticGeom:
    """Hold a geom of a compiled model at its initial pose, world frame, m.

    ``shape`` is MuJoCo's name ("plane", "box", "mesh", ...), ``size`` its three size parameters, ``rotation`` holds its
    axes in columns, ``collides`` is True if MuJoCo lets other geoms collide with it. ``vertices`` (n, 3) in the geom's
    frame and ``faces`` (m, 3) are those of a mesh, empty for other shapes.
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
    """Return the geoms of an MJCF text whose files are ``assets``.

    Raise InputError where MuJoCo does not compile it.
    """
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
