"""Define the names of array axes; every shape in a docstring or annotation uses these words.

========  ==================================================================================
word      meaning
========  ==================================================================================
batch     independent items computed together (poses, rays, trajectories)
time      consecutive steps of one sequence
height    image rows, top to bottom
width     image columns, left to right
nx ny nz  cells of a voxel grid along world x, y, z
pose      the six tangent coordinates of SE(3): translation (m), then rotation (rad)
planar    x (m), y (m), heading (rad) of a robot on the floor, counter-clockwise from world x
========  ==================================================================================
"""

from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

Matrix4: TypeAlias = Float[Any, "4 4"]  # not a `type` statement: what jaxtyping checks must be evaluated
PlanarPose: TypeAlias = Float[np.ndarray, "3"]
DirectionFrame: TypeAlias = Literal["body", "world"]  # a direction on the floor is relative to the heading, or to x
