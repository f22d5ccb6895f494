"""Pass over a log: filter the poses of each step under the map of the other chunks, then write what they saw (eq. I75).

on line:   the map holds the readings that are at least a chunk old, at the poses they were filtered at
off line:  the map holds all readings but those within a chunk, at the poses of the pass before; after a pass the poses
           are smoothed backwards and the map is made anew. Steps see a map that is one pass old: DVBF-LM's asynchronous
           chunks, with the whole log as the minibatch and the map given poses (eq. I74) in place of a gradient step.
"""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from vssm_gym.inference.latent.chart_update import ChartSensor
from vssm_gym.inference.latent.filter import LatentFilter
from vssm_gym.inference.particles import ParticleBelief
from vssm_gym.maps.latent_grid import LatentGrid
from vssm_gym.model.transition.base import Transition


class Log(eqx.Module):
    """Hold what a pass reads, a row a reading.

    Attributes:
        controls: from the scan before; the first means nothing.
        readings: of the sensor, a pytree.
    """

    controls: Float[Array, "time m"]
    readings: Any


class Pass(eqx.Module):
    """Hold the state between two steps.

    Attributes:
        belief: of the last step.
        m: the map under which the next step is inferred.
        mean: x, y (m), heading (rad) of the filtered beliefs so far.
        covariance: of their errors.
        log_evidence: of each reading, nats; tempered as the likelihood is.
    """

    belief: ParticleBelief
    m: LatentGrid
    mean: Float[Array, "time 3"]
    covariance: Float[Array, "time 3 3"]
    log_evidence: Float[Array, "time"]


@partial(jax.jit, static_argnames="chunk", donate_argnames="at")
def advance(
    charts: ChartSensor,
    transition: Transition,
    chunk: int,
    key: PRNGKeyArray,
    at: Pass,
    log: Log,
    steps: Int[Array, "n"],
    written: Float[Array, "time 3"] | None,
) -> Pass:
    """Return the state after several steps; those beyond the log change nothing.

    Args:
        charts: relation of the sensor to the map.
        transition: of the robot.
        chunk: steps whose readings the map of a step does not hold.
        key: random key of the pass.
        at: state before them.
        log: all of it.
        steps: their numbers, ascending.
        written: poses of all readings in the map, off line; None: on line, the map holds what this pass has written.
    """
    latent = LatentFilter(charts, transition)
    time = len(log.controls)
    reading = lambda t: jax.tree.map(lambda rows: rows[jnp.clip(t, 0, time - 1)], log.readings)

    def put(m: LatentGrid, t: Array, poses: Array, sign: float) -> LatentGrid:
        inside = (t >= 0) & (t < time)
        return charts.write(m, reading(t), poses[jnp.clip(t, 0, time - 1)], jnp.where(inside, sign, 0.0))

    def step(at: Pass, t: Array) -> tuple[Pass, None]:
        control = log.controls[jnp.minimum(t, time - 1)]
        found = latent.step(jax.random.fold_in(key, t), at.belief, at.m, control, reading(t), 0.0)
        moments = found.belief.gaussian()
        mean, covariance = at.mean.at[t].set(moments.mean), at.covariance.at[t].set(moments.covariance)
        m = put(at.m, t - chunk, mean if written is None else written, 1.0)
        if written is not None:
            m = put(m, t + chunk + 1, written, -1.0)
        after = Pass(found.belief, m, mean, covariance, at.log_evidence.at[t].set(found.log_evidence))
        return jax.tree.map(lambda new, old: jnp.where(t < time, new, old), after, at), None

    return jax.lax.scan(step, at, steps)[0]


@partial(jax.jit, static_argnames="sign")
def put_all(
    charts: ChartSensor, m: LatentGrid, readings: Any, poses: Float[Array, "n 3"], sign: float = 1.0
) -> LatentGrid:
    """Return the map with several readings written at their poses, or erased from there."""

    def one(m: LatentGrid, now: tuple[Any, Array]) -> tuple[LatentGrid, None]:
        return charts.write(m, *now, sign), None

    return jax.lax.scan(one, m, (readings, poses))[0]


def without_first_chunk(
    charts: ChartSensor, m: LatentGrid, readings: Any, poses: Float[Array, "time 3"], chunk: int
) -> LatentGrid:
    """Return a map of all readings without those that step 1 may not see: from the first to ``1 + chunk``."""
    near = jax.tree.map(lambda rows: rows[: chunk + 2], (readings, poses))
    return put_all(charts, m, *near, -1.0)
