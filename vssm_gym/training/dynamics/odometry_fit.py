"""Fit how a planar robot executes its commands to poses that SLAM has estimated, by the likelihood of the poses.

    z_t+1 = z_t exp(G u_t + e_t),  e_t ~ N(0, diag(floor + share |G u_t|)^2),    z^_t = z_t exp(n_t),  n_t ~ N(0, R)
    max log p(z^_1:T | u_1:T-1)  over floor, share, the gains G of distance and turn, and R

The states are integrated out by a Kalman filter over each window: an estimate errs by more than one step moves, and
taken for the truth it would make every step look noisy. No true pose is read. A maze that no evaluation uses teaches
the transition, as in DVBF-LM.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from vssm_gym.errors import InputError
from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.belief import GaussianBelief, normal_log_prob
from vssm_gym.model.transition.calibrated import CalibratedDrive
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.model.transition.odometry import Odometry

FITTED_STEPS = 25  # steps of a window, whose first state is unknown anew
FIT_UPDATES, FIT_RATE = 250, 0.1  # of Adam, and its rate at first; parameters are logarithms but for the gains
# m, m, rad, where the fit begins, and shares of the motion
FIT_FLOOR, FIT_SHARE = (1e-3, 1e-3, 1e-2), (0.05, 0.05, 0.05)
FIT_ERRORS = (2e-3, 5e-3)  # m, rad, of estimated positions and headings, where the fit begins
GAIN_SCALE = 0.1  # of a gain's deviation from 1, to a unit of the parameter that Adam moves


class Drives(NamedTuple):
    """Hold windows of drives.

    Attributes:
        motions: commanded, forward, left (m), turn (rad).
        poses: x, y (m), heading (rad) before and after each, as estimated.
    """

    motions: Float[Array, "windows steps 3"]
    poses: Float[Array, "windows steps+1 3"]


class FittedOdometry(NamedTuple):
    """Hold the outcome of a fit."""

    transition: CalibratedDrive  # of an Odometry, with the gains of distance and turn
    errors: tuple[float, float]  # standard deviations of the estimated positions (m) and headings (rad)
    log_likelihood: float  # nats a step, of the windows


class _Parameters(eqx.Module):
    """Hold what Adam moves."""

    log_floor: Float[Array, "3"]
    log_share: Float[Array, "3"]
    gain: Float[Array, "2"]  # of distance and turn: (g - 1) / GAIN_SCALE
    log_errors: Float[Array, "2"]

    def transition(self) -> CalibratedDrive:
        """Return the transition of these."""
        along, turn = 1.0 + GAIN_SCALE * self.gain
        stds = [*jnp.exp(self.log_floor), *jnp.exp(self.log_share)]
        noise = eqx.tree_at(lambda law: [*law.floor, *law.share], Odometry(FIT_FLOOR, FIT_SHARE), stds)
        return CalibratedDrive(noise, jnp.diag(jnp.stack([along, along, turn])), jnp.zeros(3))


def windows_of(motions: Sequence[np.ndarray], poses: Sequence[np.ndarray], steps: int = FITTED_STEPS) -> Drives:
    """Cut drives into windows of one length; what is left of a drive is not used.

    Args:
        motions: commanded of each drive, ``(T, 3)``.
        poses: estimated of each drive, ``(T + 1, 3)``.
        steps: of a window.

    Raises:
        InputError: a drive whose numbers of motions and poses do not fit, values that are not finite, or none as long
            as a window.
    """
    cut: list[tuple[np.ndarray, np.ndarray]] = []
    for u, z in zip(motions, poses, strict=True):
        if u.ndim != 2 or u.shape[1] != 3 or z.shape != (len(u) + 1, 3):
            raise InputError("fit_odometry", "poses", f"{len(u) + 1} x 3 of {len(u)} motions; found {z.shape}")
        if not (np.isfinite(u).all() and np.isfinite(z).all()):
            raise InputError("fit_odometry", "poses", "finite motions and poses")
        cut += [(u[t : t + steps], z[t : t + steps + 1]) for t in range(0, len(u) - steps + 1, steps)]
    if not cut:
        raise InputError("fit_odometry", "motions", f"a drive of {steps} steps or more")
    return Drives(*(jnp.asarray(np.array(part), jnp.float32) for part in zip(*cut, strict=True)))


@eqx.filter_jit
def log_likelihood(
    transition: Transition, errors: Float[Array, "2"] | tuple[float, float], drives: Drives
) -> Float[Array, ""]:
    """Return ``log p(z^_2:T | z^_1, u)`` of estimated poses, nats a step, the mean over the windows.

    Args:
        transition: of commanded motions, in the plane.
        errors: standard deviations of estimated positions (m) and headings (rad), independent from step to step.
        drives: windows.
    """
    R = jnp.diag(jnp.asarray([errors[0], errors[0], errors[1]]) ** 2)  # the same in all directions of the plane

    def advance(belief: GaussianBelief, now: tuple[Array, Array]) -> tuple[GaussianBelief, Array]:
        motion, seen = now
        predicted = transition.predict(belief, motion, 0.0)
        innovation, S = PLANAR.error(predicted.mean, seen), predicted.covariance + R
        gain = jnp.linalg.solve(S, predicted.covariance).T
        keep = jnp.eye(3) - gain
        covariance = keep @ predicted.covariance @ keep.T + gain @ R @ gain.T
        mean = PLANAR.perturb(predicted.mean, gain @ innovation)
        return GaussianBelief(mean, covariance, PLANAR), normal_log_prob(innovation, S)

    def of_window(motions: Array, poses: Array) -> Array:
        return jnp.mean(jax.lax.scan(advance, GaussianBelief(poses[0], R, PLANAR), (motions, poses[1:]))[1])

    return jnp.mean(jax.vmap(of_window)(drives.motions, drives.poses))


def fit_odometry(drives: Drives, updates: int = FIT_UPDATES) -> FittedOdometry:
    """Return the odometry of the highest likelihood, and the errors of the poses that go with it.

    Args:
        drives: windows, of :func:`windows_of`.
        updates: of Adam.
    """
    start = _Parameters(
        log_floor=jnp.log(jnp.array(FIT_FLOOR)),
        log_share=jnp.log(jnp.array(FIT_SHARE)),
        gain=jnp.zeros(2),
        log_errors=jnp.log(jnp.array(FIT_ERRORS)),
    )
    found = _climb(start, drives, updates)
    transition, errors = found.transition(), jnp.exp(found.log_errors)
    drive = transition.drive
    assert isinstance(drive, Odometry)
    floor, share = (tuple(float(value) for value in values) for values in (drive.floor, drive.share))
    plain = CalibratedDrive(Odometry(floor, share), transition.gain, transition.offset)  # type: ignore[arg-type]
    of_windows = float(log_likelihood(plain, errors, drives))
    return FittedOdometry(plain, (float(errors[0]), float(errors[1])), of_windows)


def fit_errors(transition: Transition, drives: Drives, updates: int = FIT_UPDATES) -> tuple[float, float]:
    """Return the errors of estimated poses (m, rad) of the highest likelihood under a given transition.

    Two transitions are compared each with its own.
    """
    loss = lambda log_errors: -log_likelihood(transition, jnp.exp(log_errors), drives)
    position, heading = np.exp(np.asarray(_adam(loss, jnp.log(jnp.array(FIT_ERRORS)), updates)))
    return float(position), float(heading)


def _climb(start: _Parameters, drives: Drives, updates: int) -> _Parameters:
    loss = lambda now: -log_likelihood(now.transition(), jnp.exp(now.log_errors), drives)
    found: _Parameters = _adam(loss, start, updates)
    return found


def _adam(loss: Callable[[Any], Array], start: Any, updates: int) -> Any:
    """Return the parameters after the updates."""
    rule = optax.adam(optax.cosine_decay_schedule(FIT_RATE, updates))

    def update(carry: Any, _: None) -> tuple[Any, None]:
        now, state = carry
        change, state = rule.update(jax.grad(loss)(now), state)
        return (optax.apply_updates(now, change), state), None

    run = jax.jit(lambda start: jax.lax.scan(update, (start, rule.init(start)), None, length=updates)[0][0])
    return run(start)
