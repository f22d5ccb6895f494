"""Pass over a log: filter the poses of each step under the map of the other chunks, then write what they saw (eq. I75).

on line:   the map holds the scans that are at least a chunk old, at the poses they were filtered at
off line:  the map holds all scans but those within a chunk, at the poses of the pass before; after a pass the poses are
           smoothed backwards and the map is made anew. Steps see a map that is one pass old: DVBF-LM's asynchronous
           chunks, with the whole log as the minibatch and the exact optimum of the map in place of a gradient step.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.inference.latent.chart_update import Panorama, write
from vssm_gym.inference.latent.config import LatentConfig
from vssm_gym.inference.latent.filter import LatentFilter
from vssm_gym.inference.particles import ParticleBelief
from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.scanner import Scanner
from vssm_gym.model.transition.base import Transition


class Log(eqx.Module):
    """Hold what a pass reads, a row a scan.

    Attributes:
        controls: from the scan before; the first means nothing.
        ranges: m; 0 where there is no reading.
        scans: the same at the bearings of a chart.
    """

    controls: Float[Array, "time m"]
    ranges: Float[Array, "time beams"]
    scans: Panorama


class Pass(eqx.Module):
    """Hold the state between two steps.

    Attributes:
        belief: of the last step.
        m: the map under which the next step is inferred.
        mean: x, y (m), heading (rad) of the filtered beliefs so far.
        covariance: of their errors.
        log_evidence: of each scan, nats; tempered as the likelihood is.
    """

    belief: ParticleBelief
    m: LatentGrid
    mean: Float[Array, "time 3"]
    covariance: Float[Array, "time 3 3"]
    log_evidence: Float[Array, "time"]


@partial(jax.jit, static_argnames="config", donate_argnames="at")
def advance(
    scanner: Scanner,
    transition: Transition,
    config: LatentConfig,
    key: PRNGKeyArray,
    at: Pass,
    log: Log,
    steps: Int[Array, "n"],
    written: Float[Array, "time 3"] | None,
) -> Pass:
    """Return the state after several steps; those beyond the log change nothing.

    Args:
        scanner: on the robot.
        transition: of the robot.
        config: numbers.
        key: random key of the pass.
        at: state before them.
        log: all of it.
        steps: their numbers, ascending.
        written: poses of all scans in the map, off line; None: on line, the map holds what this pass has written.
    """
    latent = LatentFilter(scanner, transition, config)
    time = len(log.ranges)

    def put(m: LatentGrid, t: Array, poses: Array, sign: float) -> LatentGrid:
        inside = (t >= 0) & (t < time)
        t = jnp.clip(t, 0, time - 1)
        scan = Panorama(log.scans.ranges[t], log.scans.valid[t])
        return write(m, scan, poses[t], scanner, config, jnp.where(inside, sign, 0.0))

    def step(at: Pass, t: Array) -> tuple[Pass, None]:
        found = latent.step(jax.random.fold_in(key, t), at.belief, at.m, log.controls[t], log.ranges[t], 0.0)
        moments = found.belief.gaussian()
        mean, covariance = at.mean.at[t].set(moments.mean), at.covariance.at[t].set(moments.covariance)
        m = put(at.m, t - config.chunk, mean if written is None else written, 1.0)
        if written is not None:
            m = put(m, t + config.chunk + 1, written, -1.0)
        after = Pass(found.belief, m, mean, covariance, at.log_evidence.at[t].set(found.log_evidence))
        return jax.tree.map(lambda new, old: jnp.where(t < time, new, old), after, at), None

    return jax.lax.scan(step, at, steps)[0]


@partial(jax.jit, static_argnames=("config", "sign"))
def put_all(
    m: LatentGrid,
    scans: Panorama,
    poses: Float[Array, "n 3"],
    scanner: Scanner,
    config: LatentConfig,
    sign: float = 1.0,
) -> LatentGrid:
    """Return the map with several scans written at their poses, or erased from there."""

    def one(m: LatentGrid, now: tuple[Panorama, Array]) -> tuple[LatentGrid, None]:
        return write(m, *now, scanner, config, sign), None

    return jax.lax.scan(one, m, (scans, poses))[0]
