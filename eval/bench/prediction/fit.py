"""Estimate on the train split what the models take as given: emission scales, and the spread of what persists."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.eval.bench.prediction.models import shown
from vssm_gym.eval.bench.prediction.run import HORIZONS, PIXEL_STRIDE, MappedDrive, every_nth, thinned, times
from vssm_gym.geometry.camera import Camera
from vssm_gym.geometry.transforms import planar_to_matrix
from vssm_gym.inference.mapping.scale_fit import PixelPairs, fit
from vssm_gym.inference.mapping.views import Views, pairs_of
from vssm_gym.model.emission_density import EmissionScales
from vssm_gym.model.transition.manifold import PLANAR

FITTED_EVERY = 10  # frames of a drive


def fitted(drives: Sequence[MappedDrive]) -> dict[str, Any]:
    """Return the parameters of greatest likelihood on some drives, as JSON values.

    Returns:
        ``emission``: scales of the drives' images about the map rendered at their true poses; ``persisting``: scales of
        an image about an earlier one, all horizons together; ``persisting_std``: root mean square of the motion along
        an axis (m) and of the turn (rad), a second.
    """
    of_map = [pairs for given in drives for pairs in _of_map(given)]
    of_time = [pairs for given in drives for pairs in _of_time(given)]
    rates = np.concatenate([_motions(given, seconds) / seconds for given in drives for seconds in HORIZONS])
    return {
        "emission": _values(fit(PixelPairs.drawn(of_map))),
        "persisting": _values(fit(PixelPairs.drawn(of_time))),
        "persisting_std": [float(np.sqrt(np.mean(rates[:, axes] ** 2))) for axes in ([0, 1], [2])],
    }


def _of_map(given: MappedDrive) -> list[PixelPairs]:
    """Return images beside what the learned map predicts at their true poses."""
    drive, context = given.drive, given.drive.context
    assert context.map is not None
    chosen = list(range(0, len(drive.planar), FITTED_EVERY))
    T_world_cam = planar_to_matrix(drive.planar[chosen]) @ context.T_body_cam
    camera = Camera.from_matrix(context.K, *context.camera)
    views = Views.stack([drive.images[frame] for frame in chosen], T_world_cam, camera)
    return pairs_of(context.map, views)


def _of_time(given: MappedDrive) -> list[PixelPairs]:
    """Return images beside earlier ones."""
    context, pairs = given.drive.context, []
    own = Camera.from_matrix(context.K, *context.camera)
    camera = every_nth(own, PIXEL_STRIDE)
    for frame in times(given.drive):
        before = jax.tree.map(lambda a: a[0], shown(given.image(frame), own, camera))
        for seconds in HORIZONS:
            after = thinned(given.image(frame + round(seconds / context.dt)), PIXEL_STRIDE)
            pairs.append(PixelPairs.of(after, before))
    return pairs


def _motions(given: MappedDrive, seconds: float) -> np.ndarray:
    """Return (forward, left, turn) between times and ``seconds`` later, ``(n, 3)`` m and rad."""
    planar, at = jnp.asarray(given.drive.planar, jnp.float32), np.array(times(given.drive))
    return np.asarray(PLANAR.error(planar[at], planar[at + round(seconds / given.drive.context.dt)]), float)


def _values(scales: EmissionScales) -> dict[str, float]:
    return {name: float(value) for name, value in vars(scales).items()}
