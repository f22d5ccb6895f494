"""Represent the posterior ``q(z_t) q(M)``: independent beliefs over state and map (PRISM).

A sample of the map is its mean, displaced by independent standard normal coefficients
(:mod:`vssm_gym.model.map_samples`).
"""

import json
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.maps import map_file
from vssm_gym.maps.voxel_map import PRIOR_OCCUPANCY_STD, VoxelMap
from vssm_gym.model.map_samples import (
    MEASUREMENT_NOISE,
    Coefficients,
    MeasurementNoise,
    deform,
    draw_coefficients,
)
from vssm_gym.model.transition.belief import Belief, GaussianBelief
from vssm_gym.model.transition.manifold import PLANAR, RIGID, Manifold
from vssm_gym.model.transition.with_rest import WithRest

MANIFOLDS: dict[str, Manifold] = {"planar": PLANAR, "rigid": RIGID}
LARGEST_REST = 64  # dimensions of a latent rest in a file
BELIEF_FORMAT, BELIEF_VERSION = "vssm_gym.Belief", 1  # of a file with a belief and no map


class Draw(NamedTuple):
    """``z, M ~ q(z) q(M)``."""

    state: Any
    map: VoxelMap | None
    coefficients: Coefficients | None  # that make the map; None without one


class LogPosterior(NamedTuple):
    """Hold the terms of ``log q(z, M)``; in float32 the sum over coefficients dwarfs the state's term."""

    state: Float[Array, ""]
    map: Float[Array, ""]  # of the coefficients; 0 without a map


class Entropy(NamedTuple):
    """Hold entropies in nats."""

    state: float
    map: float  # of occupancy, relative to the prior; 0 without a map


class Posterior(eqx.Module):
    """``q(z) q(M)``: a belief over the state beside one over the map, not correlated.

    Attributes:
        belief: over the state, in the map's frame; mostly a :class:`GaussianBelief` with ``mean`` and ``covariance``.
        map: over the map, with the errors of its poses about its frame; None where a filter keeps none.
        measurement_noise: standard deviations of one observation that the map's precisions count.
    """

    belief: Belief
    map: VoxelMap | None
    measurement_noise: MeasurementNoise = MEASUREMENT_NOISE

    def sample(self, key: PRNGKeyArray) -> Draw:
        """Draw ``z, M ~ q(z) q(M)``; :meth:`GaussianBelief.sample` draws many states.

        Args:
            key: random key.

        Returns:
            ``state``, one state; ``map``, a displaced map, and the ``coefficients`` that displace it, or None.
        """
        by_state, by_map = jax.random.split(key)
        state = jax.tree.map(lambda a: a[0], self.belief.sample(by_state, 1))
        if self.map is None:
            return Draw(state, None, None)
        drawn = draw_coefficients(by_map, self.map.pose_errors)
        return Draw(state, deform(self.map, drawn, self.measurement_noise), drawn)

    def log_prob(self, draw: Draw) -> LogPosterior:
        """``log q(z) + log q(M)``, term by term.

        Args:
            draw: of :meth:`sample`, or such a tuple.

        Returns:
            The log density of the state, and that of the coefficients of the map, ``N(0, 1)`` each: cells of a sample
            move together and have no density of their own.
        """
        drawn = [] if self.map is None or draw.coefficients is None else jax.tree.leaves(draw.coefficients)
        log_normal = lambda a: -0.5 * jnp.sum(a**2 + jnp.log(2.0 * jnp.pi))
        return LogPosterior(self.belief.log_prob(draw.state), sum(map(log_normal, drawn), jnp.float32(0.0)))

    def entropy(self) -> Entropy:
        """Return the entropies of the state (of its errors ``xi``) and of the map's occupancy, nats.

        The map's is relative to the prior: 0 for an empty map and negative for others.
        """
        return Entropy(float(self.belief.entropy()), 0.0 if self.map is None else map_entropy(self.map))

    def save(self, path: str | Path, **metadata: Any) -> None:
        """Write an ``.npz`` without pickle, complete or absent; with a map, :meth:`VoxelMap.load` reads it too.

        Args:
            path: the file; one that exists is replaced.
            metadata: what else its header holds, as JSON.

        Raises:
            InputError: a belief that is no Gaussian on a known manifold.
        """
        manifold = _manifold(self.belief)
        body, rest = (manifold.body, manifold.size) if isinstance(manifold, WithRest) else (manifold, 0)
        name = next((name for name, known in MANIFOLDS.items() if known == body), None)
        if name is None:
            raise InputError(path, "belief", f"a Gaussian over one of {', '.join(MANIFOLDS)}")
        numbers = lambda a: np.asarray(a, np.float64).tolist()
        mean = [numbers(leaf) for leaf in jax.tree.leaves(self.belief.mean)]
        belief = {"manifold": name, "mean": mean, "covariance": numbers(self.belief.covariance)}  # type: ignore[attr-defined]
        belief |= {"rest": rest} if rest else {}
        if self.map is not None:
            readings = [numbers(np.float32(leaf)) for leaf in jax.tree.leaves(self.measurement_noise)]
            self.map.save(path, **metadata, belief=belief, readings=readings)
            return
        header = {"format": BELIEF_FORMAT, "version": BELIEF_VERSION, **metadata, "belief": belief}
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, header=np.frombuffer(json.dumps(header).encode(), np.uint8))

    @classmethod
    def load(cls, path: str | Path) -> "Posterior":
        """Read a file written by :meth:`save`.

        Args:
            path: the ``.npz`` file.

        Returns:
            The posterior, in float32.

        Raises:
            InputError: the file is missing, damaged or of another version, or a map file without a belief.
        """
        header = map_file.read_header(path, {map_file.FORMAT, BELIEF_FORMAT})
        if header["format"] == BELIEF_FORMAT and header.get("version") != BELIEF_VERSION:
            raise InputError(
                path, "version", f"{BELIEF_FORMAT} version {BELIEF_VERSION}, found {header.get('version')!r:.80}"
            )
        stored = header.get("belief")
        if not isinstance(stored, dict):
            raise InputError(path, "belief", "a belief over the state; this file holds a map alone")
        manifold = next((known for name, known in MANIFOLDS.items() if name == stored.get("manifold")), None)
        if manifold is None:
            raise InputError(path, "belief.manifold", f"one of {', '.join(MANIFOLDS)}")
        rest = stored.get("rest", 0)
        if isinstance(rest, bool) or not (isinstance(rest, int) and 0 <= rest <= LARGEST_REST):
            raise InputError(path, "belief.rest", f"a whole number from 0 to {LARGEST_REST}; found {rest!r:.80}")
        manifold = WithRest(manifold, rest) if rest else manifold
        form = manifold.resting(jnp.eye(4))
        leaves, n = jax.tree.leaves(form), len(manifold.turns)
        shapes = [leaf.shape for leaf in leaves]
        mean = _arrays(path, "belief.mean", stored.get("mean"), shapes)
        (covariance,) = _arrays(path, "belief.covariance", [stored.get("covariance")], [(n, n)])
        P = np.asarray(covariance, np.float64)
        rounding = 1e-5 * np.abs(P).max()
        if np.abs(P - P.T).max() > rounding or np.linalg.eigvalsh(P).min() < -rounding:
            raise InputError(path, "belief.covariance", "a symmetric matrix without negative eigenvalues")
        belief = GaussianBelief(jax.tree.unflatten(jax.tree.structure(form), mean), covariance, manifold)
        R = np.asarray(manifold.pose(belief.mean), np.float64)[:3, :3]
        if np.abs(R - _rotation(R)).max() > 1e-3:
            raise InputError(path, "belief.mean", "a pose whose 3x3 part is a rotation")
        if header["format"] == BELIEF_FORMAT:
            return cls(belief, None)
        readings = _arrays(path, "readings", header.get("readings", jax.tree.leaves(MEASUREMENT_NOISE)), [()] * 3)
        if not all(float(std) > 0.0 for std in readings):
            raise InputError(path, "readings", "standard deviations above 0")
        noise = MeasurementNoise(*(float(std) for std in readings))
        return cls(belief, VoxelMap.load(path), noise)


def map_entropy(m: VoxelMap) -> float:
    """``H(M) - H(prior) = sum_cells 1/2 log(lambda_0 / lambda)``, nats; 0 for an empty map, negative for others.

    Entropy is relative to the prior, ``lambda_0 = PRIOR_OCCUPANCY_STD^-2``, because the absolute entropy of a grid
    grows with its extent. Unobserved cells, inside the grid or beyond it, contribute nothing, so that a dense and a
    block-sparse map of the same images have the same entropy. The constant is ``1/2 log(2 pi e / lambda_0) = 3.72``
    nats a cell.

    Only occupancy counts (VSSM-LM): colour is observed in the band around surfaces only, so that its entropy would
    mostly count the same cells twice, and no planner uses it.
    """
    precision = np.asarray(m.occupancy_precision)
    prior = np.float32(PRIOR_OCCUPANCY_STD**-2)  # as cells hold it, so that an empty map's entropy is 0
    known = precision[precision != prior].astype(np.float64)  # most cells are unobserved: ten times faster
    return 0.5 * float(np.sum(np.log(float(prior) / known)))


def _rotation(R: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to a matrix; zeros where there is none."""
    try:
        U, _, V = np.linalg.svd(R)
    except np.linalg.LinAlgError:
        return np.zeros_like(R)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ V)]) @ V


def _manifold(belief: Belief) -> Any:
    return belief.manifold if isinstance(belief, GaussianBelief) else None


def _arrays(path: str | Path, field: str, values: Any, shapes: list[tuple[int, ...]]) -> list[Array]:
    try:
        with np.errstate(over="ignore"):  # values that overflow float32 are refused below
            arrays = [np.asarray(value, np.float64).astype(np.float32) for value in values]
    except (TypeError, ValueError, OverflowError):
        arrays = []
    if [a.shape for a in arrays] != shapes or not all(np.isfinite(a).all() for a in arrays):
        raise InputError(path, field, f"finite numbers of shapes {shapes}")
    return [jnp.asarray(a) for a in arrays]
