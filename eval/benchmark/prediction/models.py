"""List the world models of the package that enter the benchmark by name."""

from collections.abc import Callable
from functools import partial

from vssm_gym.eval.bench.prediction.contract import WorldModel
from vssm_gym.eval.bench.prediction.models import Persistence, VssmLm

PREDICTORS: dict[str, Callable[[], WorldModel]] = {
    "vssm_lm": VssmLm,
    "map_at_mean_pose": partial(VssmLm, sampled=False),
    "last_image": Persistence,
}
