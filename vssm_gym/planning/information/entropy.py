"""``H(M) = sum_cells 1/2 log(2 pi e / lambda)``, of occupancy, relative to the prior (SPEC 1, 8)."""

import numpy as np

from vssm_gym.voxel_map import PRIOR_OCCUPANCY_STD, VoxelMap


def entropy(m: VoxelMap) -> float:
    """``H(M) - H(prior) = sum_cells 1/2 log(lambda_0 / lambda)``, nats; 0 for an empty map, less for a known one.

    Relative to the prior, ``lambda_0 = PRIOR_OCCUPANCY_STD^-2``, because the absolute entropy of a grid grows with its
    extent: cells that nothing observed, inside the grid or beyond it, contribute nothing, and a dense and a
    block-sparse map of the same images have the same entropy. The constant is ``1/2 log(2 pi e / lambda_0) = 3.72``
    nats a cell.

    Occupancy alone (SPEC 1): colour is observed in the band around surfaces only, so its entropy adds little but a
    second count of the same cells, and nothing that a robot plans with.
    """
    precision = np.asarray(m.occupancy_precision)
    prior = np.float32(PRIOR_OCCUPANCY_STD**-2)  # as cells hold it, so that an empty map's entropy is 0
    known = precision[precision != prior].astype(np.float64)  # most are not: a tenth of the time
    return 0.5 * float(np.sum(np.log(float(prior) / known)))
