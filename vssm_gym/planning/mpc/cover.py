"""Cover the car's rectangle by discs, closely enough to pass where value iteration with the rectangle passes (P11).

    radius^2 = (length / 2 columns)^2 + (width / 2 rows)^2

Discs on the centre line alone reach 6 cm beyond the bumpers, so a plan would stop before goals that the critic reaches.
"""

import numpy as np

from vssm_gym.geometry.car import Car


def cover(car: Car, rows: int, columns: int) -> tuple[np.ndarray, float]:
    """Return discs around the outer cells of a grid of ``rows`` by ``columns`` over the footprint.

    What is under the middle of the car must have come through its edge. The discs reach ``radius - width / 2 rows``
    beyond its sides and ``radius - length / 2 columns`` beyond its ends: 1.4 and 1.3 cm for 3 x 6 of the default car.

    Returns:
        Centres ahead of the rear axle and to its left, ``(n, 2)`` float64, m, and the radius, m.
    """
    x = car.length * (np.arange(columns) + 0.5) / columns - car.rear_overhang
    y = car.width * ((np.arange(rows) + 0.5) / rows - 0.5)
    inner = np.zeros((columns, rows), dtype=bool)
    inner[1:-1, 1:-1] = True
    centres = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)[~inner]
    return centres, float(np.hypot(0.5 * car.length / columns, 0.5 * car.width / rows))
