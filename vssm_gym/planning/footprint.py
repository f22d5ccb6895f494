"""The car's footprint, an oriented rectangle, against the cells of a floor plan.

    blocked(x, y, heading) = any occupied cell overlaps the rectangle of the pose, grown by a margin
"""

import numpy as np

from vssm_gym.car import Car
from vssm_gym.errors import InputError


def car_discs(car: Car, n: int) -> tuple[np.ndarray, float]:
    """``n`` equal discs on the car's centre line whose union covers its footprint.

    Disc ``i`` covers the slice ``i`` of ``n`` of the rectangle: ``radius^2 = (length / 2n)^2 + (width / 2)^2``, the
    smallest that ``n`` equal discs on the line can have. They reach beyond the rectangle's sides by
    ``radius - width / 2`` at most (4.1, 1.2 and 0.5 cm for 2, 4 and 6 discs of the default car).

    Returns:
        Positions of the centres ahead of the rear axle, ``(n,)`` float64, m, rear to front, and the radius, m.
    """
    if n < 1:
        raise InputError("car_discs", "n", f"at least one disc; found {n}")
    offsets = car.length * (np.arange(n) + 0.5) / n - car.rear_overhang
    return offsets, float(np.hypot(0.5 * car.length / n, 0.5 * car.width))
