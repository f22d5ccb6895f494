"""Compute ``I(z; x) = 1/2 log det(I + Sigma F)``: the information of an imagined image about the pose (eq. P43).

``Sigma = diag(std^2)`` is the uncertainty of the pose (x, y, heading) before the image, and ``F = sum_pixels J J^T /
sigma^2`` the Fisher information of depth measurements of known surfaces, point to plane. A robot that slides by ``d``
and turns by ``a`` about its axis at ``c`` sees the point ``p`` with normal ``n`` nearer by ``n . (d + a e_z x (p -
c))``. Unknown space has no information, and a bare wall none about the position along it.
"""

import numpy as np

from vssm_gym.geometry.camera import Camera

MEASUREMENTS = 1200  # independent ones per image, however many pixels it has; `InformationConfig.pixels` by default
DEPTH_EDGE = 0.15  # fraction of the depth; neighbours further apart lie on different surfaces


def pose_gain(
    depth: np.ndarray,
    surface: np.ndarray,
    T_world_cam: np.ndarray,
    camera: Camera,
    std: np.ndarray,
    measurement_std: float,
) -> np.ndarray:
    """Return the expected nats about the pose from each image.

    Args:
        depth: ``(views, height, width)`` imagined z-depth, m.
        surface: the same, bool: measurements of a known surface.
        T_world_cam: ``(views, 4, 4)`` camera poses; the camera stands on the robot's axis.
        camera: of the images.
        std: ``(3,)`` of x, y (m) and heading (rad) before the image; zeros: the pose is known, and the gain zero.
        measurement_std: m, of one of an image's MEASUREMENTS.

    Returns:
        ``(views,)`` float64.
    """
    if not np.any(std):
        return np.zeros(len(depth))
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    p = np.einsum("vij,vhwj->vhwi", T_world_cam[:, :3, :3], depth[..., None] * rays)  # from the camera, world axes
    here = p[:, :-1, :-1]
    right, down = p[:, :-1, 1:] - here, p[:, 1:, :-1] - here
    n = np.cross(right, down)
    length = np.linalg.norm(n, axis=-1)
    z = depth[:, :-1, :-1]
    whole = surface[:, :-1, :-1] & surface[:, :-1, 1:] & surface[:, 1:, :-1] & (length > 0.0)
    whole &= np.maximum(np.abs(depth[:, :-1, 1:] - z), np.abs(depth[:, 1:, :-1] - z)) < DEPTH_EDGE * z
    n = np.where(whole[..., None], n / np.maximum(length, 1e-12)[..., None], 0.0)
    turn = n[..., 1] * here[..., 0] - n[..., 0] * here[..., 1]
    J = np.stack([n[..., 0], n[..., 1], turn], axis=-1).reshape(len(depth), -1, 3)
    F = np.einsum("vni,vnj->vij", J, J) * (MEASUREMENTS / (camera.width * camera.height)) / measurement_std**2
    scaled = np.eye(3) + std[:, None] * F * std
    return 0.5 * np.linalg.slogdet(scaled)[1]
