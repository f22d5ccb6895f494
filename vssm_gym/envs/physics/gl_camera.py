"""Render the boxes' faces with MuJoCo's OpenGL renderer: the twin of the raycast camera for machines with OpenGL.

    z-depth d = n f / (n + b (f - n)),    b the depth buffer, 1 at the near and 0 at the far plane

Geometry, pose, intrinsics, textures and lights are those of the raycast camera, so depths agree to float32. Colours
differ by a few grey levels, since OpenGL filters textures differently and computes the light at the corners of cells.
There are no shadows, reflections or antialiasing: an image is one draw and one read of colour and depth.
"""

import importlib
import weakref
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numba
import numpy as np

from vssm_gym.envs.rendering.box_faces import box_triangles
from vssm_gym.envs.rendering.gl_backends import find_backend
from vssm_gym.envs.rendering.shading import AMBIENT, HEAD, HEAD_RANGE, LAMP, LAMP_DIRECTION, SKY
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.envs.textures.registry import texture_atlas
from vssm_gym.geometry.axes import Matrix4
from vssm_gym.geometry.camera import Camera

NEAR_PLANE = 0.01  # m, nearest depth; half of the thinnest thing, a window's pane


class GlCamera:
    """Render the boxes as a pinhole camera sees them; one image at a time, from any thread.

    Args:
        boxes: the solid boxes.
        camera: intrinsics, which hold the image size.
        backend: ``egl``, ``osmesa`` or ``glfw``; by default the first that works, or the one in ``MUJOCO_GL``.

    Raises:
        InputError: no OpenGL on this machine; the message says what to install.
    """

    def __init__(self, boxes: Sequence[SolidBox], camera: Camera, backend: str | None = None) -> None:
        self.camera = camera
        self._boxes = list(boxes)
        self._backend = find_backend() if backend is None else backend
        self._thread: ThreadPoolExecutor | None = None

    @property
    def name(self) -> str:
        """Return the name to be recorded with results: ``gl-egl``, ``gl-osmesa`` or ``gl-glfw``."""
        return f"gl-{self._backend}"

    def __getstate__(self) -> dict[str, Any]:
        return {"camera": self.camera, "_boxes": self._boxes, "_backend": self._backend, "_thread": None}

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """Render the image at a camera pose.

        Args:
            T_world_cam: ``(4, 4)``, m.

        Returns:
            ``rgb`` uint8 ``(H, W, 3)`` and z-depth float32 ``(H, W)`` in m, 0 where nothing is seen.
        """
        if self._thread is None:
            # An OpenGL context belongs to one thread: it is made, used and freed in the camera's own.
            self._thread = ThreadPoolExecutor(1, thread_name_prefix="gl")
            self._picture = self._thread.submit(_Picture, self._boxes, self.camera, self._backend).result()
            self._release = weakref.finalize(self, _release, self._thread, self._picture)
        return self._thread.submit(self._picture.draw, np.asarray(T_world_cam, dtype=np.float64)).result()

    def close(self) -> None:
        """Free the OpenGL context and its thread; the next image creates new ones."""
        if self._thread is not None:
            self._release()
            self._thread = None
            del self._picture


def _release(thread: ThreadPoolExecutor, picture: "_Picture") -> None:
    try:
        thread.submit(picture.free).result()
    except RuntimeError:  # the interpreter is ending and has stopped all threads
        picture.free()
    thread.shutdown()


class _Picture:
    """Hold an OpenGL context with the scene in it; all calls must come from the thread that made it."""

    def __init__(self, boxes: Sequence[SolidBox], camera: Camera, backend: str) -> None:
        self._width, self._height = camera.width, camera.height
        corners = np.array([box.center for box in boxes]), np.array([box.size for box in boxes])
        self._center = corners[0].mean(axis=0)
        self._radius = float(
            np.max(np.linalg.norm(corners[0] - self._center, axis=1) + np.linalg.norm(corners[1], axis=1))
        )
        (fx, _, cx), (_, fy, cy), _ = camera.K
        # The frustum's sides at depth 1: pixel centres are integers, so the image's edges lie half a pixel outside.
        self._left, self._right = (-0.5 - cx) / fx, (camera.width - 0.5 - cx) / fx
        self._top, self._bottom = (0.5 + cy) / fy, (cy + 0.5 - camera.height) / fy
        model = _looks(boxes, camera).compile()
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        self._gl = importlib.import_module(f"mujoco.{backend}").GLContext(camera.width, camera.height)
        self._gl.make_current()
        self._scene = mujoco.MjvScene(model, model.ngeom)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, self._scene)
        self._scene.flags[:] = 0  # no shadows, reflections, haze, sky
        self._scene.flags[mujoco.mjtRndFlag.mjRND_CULL_FACE] = 1
        _light(self._scene)
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50)
        # As the buffer is, 0 far away: turned over, float32 would have nothing left of distant depths.
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._view = mujoco.MjrRect(0, 0, camera.width, camera.height)
        self._rgb = np.empty((camera.height, camera.width, 3), dtype=np.uint8)
        self._buffer = np.empty((camera.height, camera.width), dtype=np.float32)

    def draw(self, T_world_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return new colour and depth arrays of one pose."""
        position = T_world_cam[:3, 3]
        far = float(np.linalg.norm(position - self._center)) + self._radius + 1.0
        for eye in self._scene.camera:  # one for each eye of a stereo view; both the same
            eye.pos[:], eye.forward[:], eye.up[:] = position, T_world_cam[:3, 2], -T_world_cam[:3, 1]
            eye.frustum_near, eye.frustum_far = NEAR_PLANE, far
            eye.frustum_center = 0.5 * NEAR_PLANE * (self._left + self._right)
            eye.frustum_width = 0.5 * NEAR_PLANE * (self._right - self._left)  # half of it
            eye.frustum_top, eye.frustum_bottom = NEAR_PLANE * self._top, NEAR_PLANE * self._bottom
        self._scene.lights[_HEAD].pos[:] = position
        mujoco.mjr_render(self._view, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._buffer, self._view, self._context)
        rgb, depth = np.empty_like(self._rgb), np.empty_like(self._buffer)
        _develop(self._rgb, self._buffer, NEAR_PLANE, far, rgb, depth)
        return rgb, depth

    def free(self) -> None:
        """Free the context."""
        self._context.free()
        self._gl.free()


def _looks(boxes: Sequence[SolidBox], camera: Camera) -> mujoco.MjSpec:
    """Build a model of the boxes as meshes, one for each texture and colour."""
    spec = mujoco.MjSpec()
    names = sorted({box.material.texture for box in boxes})
    for name, image in zip(names, texture_atlas(names), strict=True):
        height, width, channels = image.shape
        texture = spec.add_texture(
            name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=channels
        )
        texture.data = image.tobytes()
    groups: dict[tuple[str, tuple[float, float, float]], list[SolidBox]] = {}
    for box in boxes:
        groups.setdefault((box.material.texture, box.material.color), []).append(box)
    for i, ((texture_name, color), members) in enumerate(groups.items()):
        name = f"look {i}"
        material = spec.add_material(name=name, rgba=[*color, 1.0], specular=0.0, shininess=0.0)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture_name
        soup = box_triangles(members)
        # A shell needs no volume: boxes may overlap.
        mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        mesh.uservert, mesh.userface = soup.vertices.ravel(), soup.triangles.ravel()
        mesh.usernormal, mesh.userfacenormal = soup.normals.ravel(), soup.triangles.ravel()
        mesh.usertexcoord, mesh.userfacetexcoord = soup.texture.ravel(), soup.triangles.ravel()
        kind = mujoco.mjtGeom.mjGEOM_MESH
        spec.worldbody.add_geom(name=name, type=kind, meshname=name, material=name, contype=0, conaffinity=0)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = camera.width, camera.height
    spec.visual.quality.offsamples = spec.visual.quality.shadowsize = 0
    spec.visual.headlight.active = 0
    return spec


_HEAD = 2  # the light that goes with the camera


def _light(scene: mujoco.MjvScene) -> None:
    """``ambient + lamp (1 + n.l) / 2 + head cos / (1 + (distance / range)^2)``, the raycast camera's light.

    OpenGL's lamps give ``max(0, n.l)``; a second lamp from below with negative light makes it ``n.l``.
    """
    directional, spot = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, mujoco.mjtLightType.mjLIGHT_SPOT
    down = -np.array(LAMP_DIRECTION)
    ambient, square = AMBIENT + 0.5 * LAMP, 1.0 / HEAD_RANGE**2
    rows = [  # type, direction, ambient, diffuse, falloff with the distance squared
        (directional, down, ambient, 0.5 * LAMP, 0.0),
        (directional, -down, 0.0, -0.5 * LAMP, 0.0),
        (spot, down, 0.0, HEAD, square),
    ]
    scene.nlight = len(rows)
    for light, (kind, direction, all_round, diffuse, falloff) in zip(scene.lights, rows, strict=False):
        light.type, light.castshadow, light.headlight, light.texid = kind, 0, 0, -1
        light.dir[:], light.ambient[:], light.diffuse[:], light.specular[:] = direction, all_round, diffuse, 0.0
        light.exponent, light.cutoff = 0.0, 180.0  # the spot shines all round
        light.attenuation[:] = 1.0, 0.0, falloff


@numba.njit(nogil=True, cache=True)
def _develop(seen, buffer, near, far, rgb, depth):
    """Flip the read image upright, convert its depth to metres, and fill in the sky where nothing was drawn."""
    height, width = buffer.shape
    for i in range(height):
        for j in range(width):
            b = float(buffer[height - 1 - i, j])
            if b > 0.0:
                depth[i, j] = near * far / (near + b * (far - near))
                for k in range(3):
                    rgb[i, j, k] = seen[height - 1 - i, j, k]
            else:
                depth[i, j] = 0.0
                for k in range(3):
                    rgb[i, j, k] = np.uint8(255.0 * SKY[k] + 0.5)
