"""Scale depth for policies: to [0, 1], and to an image of bytes.

normalized = min(depth / max_depth, 1)        depth_image = ceil(255 normalized)        0 = no reading, nothing else
"""

import numpy as np
from jaxtyping import Float, UInt8

POLICY_MAX_DEPTH = 5.0  # m: across most rooms; a policy needs no distinction beyond


def normalized(
    depth: Float[np.ndarray, "*batch height width"], max_depth: float = POLICY_MAX_DEPTH
) -> Float[np.ndarray, "*batch height width"]:
    """Return depth in [0, 1] of depth in m; 0 remains no reading, and no reading but that becomes 0."""
    return np.minimum(depth / np.float32(max_depth), np.float32(1.0))


def depth_image(depth: Float[np.ndarray, "*batch height width"]) -> UInt8[np.ndarray, "*batch height width 1"]:
    """Return a grey image of depth in m: 1 at the camera, 255 from ``POLICY_MAX_DEPTH`` on, 0 = no reading."""
    return np.ceil(np.float32(255.0) * normalized(depth)).astype(np.uint8)[..., None]
