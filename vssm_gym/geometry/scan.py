"""Convert depth images to the scans that ``vssm_gym/WorldModelNav-v0`` observes: 64 depths in a horizontal plane.

    scan_k = min over rows v in {floor(cy), ceil(cy)} of depth(v, round(u_k)),   u_k = (k + 1/2) W / 64 - 1/2

``k = 0`` is the left edge; depths are z-depths, m, 0 = no reading. The scan takes the nearer reading of the two rows
beside the horizon (of one row where the height is odd); readings beyond ``max_depth`` become 0. With a camera of 64 x 1
pixels the rays are exactly those of the imagined scan, with others they are off by half a pixel.
"""

import numpy as np

from vssm_gym.geometry.camera import MAX_DEPTH

BEAMS = 64  # of vssm_gym/WorldModelNav-v0


def scan_of(depth: np.ndarray, max_depth: float = MAX_DEPTH) -> np.ndarray:
    """Return scans ``(*batch, 64)`` float32 of depth images ``(*batch, height, width)``, m."""
    height, width = depth.shape[-2:]
    middle = 0.5 * (height - 1)
    rows = depth[..., sorted({int(np.floor(middle)), int(np.ceil(middle))}), :]
    columns = np.round((np.arange(BEAMS) + 0.5) * width / BEAMS - 0.5).astype(int)
    near = np.where(rows > 0.0, rows, np.inf)[..., columns].min(axis=-2)
    return np.where(near <= max_depth, near, 0.0).astype(np.float32)
