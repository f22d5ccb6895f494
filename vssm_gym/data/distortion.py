"""Compute the distortion of a lens."""

import numpy as np


def reach(k: np.ndarray) -> float:
    """Return the normalised radius up to which a lens's radial distortion grows; infinite where it always does.

    It is the smallest root of ``d/dr [r (1 + k1 r^2 + k2 r^4 + k3 r^6)]``: farther points would fold back.
    """
    k1, k2, _, _, k3 = k
    roots = np.roots([7.0 * k3, 5.0 * k2, 3.0 * k1, 1.0])  # of the radius squared
    turns = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
    return float(np.sqrt(turns.min())) if len(turns) else np.inf


def distort(x: np.ndarray, y: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convert undistorted to distorted normalised coordinates (Brown-Conrady); ``k`` = (k1, k2, p1, p2, k3)."""
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
