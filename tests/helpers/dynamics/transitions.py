"""Make learned transitions with random weights: what holds for every network holds for a trained one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from vssm_gym.model.transition import Imu, ImuNoise, MotionNoise, Planar
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.body_axes import body_axes
from vssm_gym.model.transition.learned import LearnedTransition, Scales, untrained


def random_transition(
    nominal: Transition | None = None, size: int = 2, further: int = 0, spread: float = 0.3, seed: int = 0
) -> LearnedTransition:
    """Return a correction of an IMU (or of another nominal step) with random weights and wide noise.

    Args:
        nominal: that is corrected.
        size: dimensions of the rest.
        further: controls beyond those of the nominal transition.
        spread: of the outputs' weights.
        seed: of the weights.
    """
    nominal = Imu(ImuNoise(0.1, 0.1, 0.1, 0.1)) if nominal is None else nominal
    rng, n = np.random.default_rng(seed), len(nominal.manifold.turns)
    inputs = body_axes(nominal.manifold).features + nominal.controls + further
    scales = Scales(
        jnp.asarray(rng.normal(size=inputs), jnp.float32),
        jnp.asarray(rng.uniform(1.0, 3.0, inputs), jnp.float32),
        jnp.asarray(rng.uniform(0.05, 0.2, n), jnp.float32),
        jnp.asarray(0.1),
    )
    learned = untrained(jax.random.key(seed), nominal, scales, size, further, width=16, depth=2)
    some = lambda a, scale: jnp.asarray(rng.normal(size=a.shape) * scale, jnp.float32)
    network = learned.network
    changed = (some(network.leave, spread / 4.0), network.linear + some(network.linear, spread))
    network = eqx.tree_at(lambda net: (net.leave, net.linear), network, changed)
    return eqx.tree_at(lambda t: t.network, learned, network)


def random_planar(seed: int = 0) -> LearnedTransition:
    """Return a correction of a holonomic robot with random weights."""
    return random_transition(Planar(MotionNoise(0.02, 0.004)), seed=seed)


def noisy_transition(nominal: Transition, stds: tuple[float, ...], inputs: int) -> LearnedTransition:
    """Return a transition that corrects nothing, with noise of its own.

    Args:
        nominal: that is not corrected.
        stds: of the coordinates of a step of 0.1 s: one for each three, or for the places and for the angle of a plane.
        inputs: of the network, without the rest.
    """
    errors = np.repeat(stds, 3) if len(stds) == 4 else np.array([stds[0], stds[0], stds[1]])
    scales = Scales(jnp.zeros(inputs), jnp.ones(inputs), jnp.asarray(errors, jnp.float32), jnp.asarray(0.1))
    return untrained(jax.random.key(0), nominal, scales)
