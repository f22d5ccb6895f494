"""Render what each pixel's ray ``p(z) = c + z R K^-1 [i, j, 1]^T`` meets first, with texture and light.

Equal inputs give equal bytes.
"""

import copy
from collections.abc import Sequence

import numpy as np

from vssm_gym.envs.rendering.raster import SIDES, box_frames, draw
from vssm_gym.envs.rendering.shading import looks_of, shade
from vssm_gym.envs.scenes.solids import SolidBox
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4
from vssm_gym.geometry.camera import Camera


class RaycastCamera:
    """Render the boxes as a pinhole camera sees them; several threads may render at once.

    Args:
        boxes: the solid boxes, at least one.
        camera: intrinsics, which hold the image size.
    """

    name = "raycast"  # recorded with results

    def __init__(self, boxes: Sequence[SolidBox], camera: Camera) -> None:
        if not boxes:
            raise InputError("camera", "boxes", "at least one box to see; found none")
        self._frames, self._looks = box_frames(boxes), looks_of(boxes)
        self._set(camera)

    def with_intrinsics(self, camera: Camera) -> "RaycastCamera":
        """Return a camera of other intrinsics that shares the scene's tables."""
        other = copy.copy(self)
        other._set(camera)
        return other

    def _set(self, camera: Camera) -> None:
        self.camera = camera
        K = np.asarray(camera.K, dtype=np.float64)
        self._intrinsics = float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
        fx, fy, cx, cy = self._intrinsics
        x, y = (np.arange(camera.width) - cx) / fx, (np.arange(camera.height) - cy) / fy
        self._length2 = (1.0 + np.square(x) + np.square(y)[:, None]).astype(np.float32)

    def render(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """Render the image at a camera pose.

        Args:
            T_world_cam: ``(4, 4)``, m.

        Returns:
            ``rgb`` uint8 ``(H, W, 3)`` and z-depth float32 ``(H, W)`` in m, 0 where a ray hits nothing.

        Raises:
            InputError: a pose that is not finite.
        """
        T, nearness, face = self._draw(T_world_cam)
        rgb, depth = np.empty((*face.shape, 3), dtype=np.uint8), np.empty(face.shape, dtype=np.float32)
        looks = self._looks
        tables = looks.shifts, looks.colors, looks.textures, looks.texels, looks.levels
        shade(T, *self._intrinsics, self._frames, *tables, self._length2, nearness, face, rgb, depth)
        return rgb, depth

    def first_boxes(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray]:
        """Return the z-depth of :meth:`render`, and the index of the box in each pixel.

        Int32 ``(H, W)``, -1 for none.
        """
        _, nearness, face = self._draw(T_world_cam)
        depth = np.divide(1.0, nearness, out=np.zeros_like(nearness), where=face >= 0)
        return depth, face // SIDES

    def _draw(self, T_world_cam: Matrix4) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        T = np.ascontiguousarray(T_world_cam, dtype=np.float64)
        if T.shape != (4, 4) or not np.isfinite(T).all():
            raise InputError("camera", "T_world_cam", f"a finite 4x4 matrix; found {T_world_cam!r:.80}")
        size = self.camera.height, self.camera.width
        nearness, face = np.empty(size, dtype=np.float32), np.empty(size, dtype=np.int32)
        draw(T, self._frames, *self._intrinsics, nearness, face)
        return T, nearness, face

    def close(self) -> None:
        """Do nothing: there is no context to free."""
