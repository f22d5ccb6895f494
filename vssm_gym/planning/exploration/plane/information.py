"""Estimate what scans along a trajectory will say about the map, from ancestral samples alone (eq. P50).

    M_i ~ q(M),    z_1:T ~ q(z_0) prod p(z_t | z_t-1, u_t),    x_t ~ p(x_t | z_t, M_i),    y = x + e,  e ~ N(0, s^2)
    I = sum_b H[y_b,1:T] - E_M H[y_b,1:T | M],    both by nearest neighbours (eq. P44)

The readings of one direction b of the world, along the trajectory, are taken together: what is seen twice counts once.
A k-NN estimate over all readings at once has more dimensions than samples, and grows with the spread of one reading as
if all of them spread: directions are therefore added up, as if different ones saw different cells.
The noise e is finer than what is worth knowing. Without it equal readings (no surface in reach) would have an entropy
of minus infinity; with it ``I`` can only fall.
"""

from dataclasses import dataclass
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.planning.exploration.information.nearest_neighbours import knn_information

Poses: TypeAlias = Float[Array, "candidates draws times 3"]


@dataclass(frozen=True)
class SampledInformationConfig:
    """Configure the estimate.

    Args:
        draws: of the map and the trajectory for the marginal, and of scans under each map.
        maps: of the draws whose conditional entropies are averaged.
        neighbour: k, whose distance is taken.
        fineness: s, m.
    """

    draws: int = 10
    maps: int = 2
    neighbour: int = 3
    fineness: float = 0.005

    def __post_init__(self) -> None:
        if not 1 <= self.neighbour < self.draws:
            raise InputError("SampledInformationConfig", "draws", f"more than {self.neighbour}, not {self.draws}")
        if not 1 <= self.maps <= self.draws:
            raise InputError("SampledInformationConfig", "maps", f"1 to {self.draws}, not {self.maps}")
        if not self.fineness > 0.0:
            raise InputError("SampledInformationConfig", "fineness", f"above 0 m, not {self.fineness}")


def scan_information(
    key: PRNGKeyArray, model: ScanModel, poses: Poses, config: SampledInformationConfig
) -> Float[Array, "candidates"]:
    """Return ``I(M; x_1:T)`` of each candidate, nats.

    All candidates are judged under the same maps and the same noise.

    Args:
        key: of all draws.
        model: of the scans, its scanner with as many beams as are to be compared.
        poses: draws of each candidate's trajectory where it measures: x, y (m), heading (rad), as many as
            ``config.draws``.
        config: numbers of draws.
    """
    if poses.shape[1] != config.draws:
        raise InputError("scan_information", "poses", f"{config.draws} draws a candidate; found {poses.shape[1]}")
    by_map, by_scan, by_noise = jax.random.split(key, 3)
    models = eqx.filter_vmap(lambda k: model.draw_map(k))(jax.random.split(by_map, config.draws))
    first = jax.tree.map(lambda leaf: leaf[: config.maps] if eqx.is_array(leaf) else leaf, models)

    def measure(one: ScanModel, k: PRNGKeyArray, z: Float[Array, "*draws times 3"]) -> Array:
        x = one.sample(k, z)
        x = jnp.where(x > 0.0, x, model.scanner.max_range)
        return x + config.fineness * jax.random.normal(jax.random.fold_in(k, 1), x.shape)

    def judge(z: Float[Array, "draws times 3"]) -> Float[Array, ""]:
        alone = jax.random.split(by_scan, config.draws)
        marginal = eqx.filter_vmap(measure)(models, alone, z)
        under = eqx.filter_vmap(measure, in_axes=(eqx.if_array(0), 0, None))
        conditional = under(first, jax.random.split(by_noise, config.maps), z)
        along = jax.vmap(lambda a, b: knn_information(a, b, config.neighbour))
        return jnp.sum(along(jnp.moveaxis(marginal, -1, 0), jnp.moveaxis(conditional, -1, 0)))

    return jax.lax.map(judge, poses)


def facing_x(poses: Poses) -> Poses:
    """Return trajectories as they are to a scanner that sees all around: beams count from the world's x axis.

    Each pose keeps its error of the heading, and loses the heading that all draws share.
    """
    c, s = jnp.cos(poses[..., 2]), jnp.sin(poses[..., 2])
    mean = jnp.arctan2(jnp.mean(s, axis=1, keepdims=True), jnp.mean(c, axis=1, keepdims=True))
    off = jnp.arctan2(jnp.sin(poses[..., 2] - mean), jnp.cos(poses[..., 2] - mean))
    return poses.at[..., 2].set(off)
