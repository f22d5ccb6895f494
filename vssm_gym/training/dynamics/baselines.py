"""Fit the parametric models that a learned transition is compared with, by least squares over several steps.

    min_c  sum_windows sum_k rho(|p_k(c) - p^_k|^2 / s_p^2 + |R_k(c) - R^_k|^2 / s_R^2)

``k`` are a few horizons of every window, ``p_k(c)`` and ``R_k(c)`` the pose that the model with constants ``c``
predicts from the first measured state, and ``rho`` SciPy's soft L1: long horizons are far off where the constants are
wrong.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import least_squares

from vssm_gym.model.transition.base import Transition
from vssm_gym.model.transition.calibrated import CalibratedDrive, CalibratedImu, ImuConstants
from vssm_gym.model.transition.imu import Imu
from vssm_gym.training.dynamics.windows import Windows

FITTED_WINDOWS = 64  # of those given at most: constants are few
COMPARED_AT = (0.1, 0.3, 1.0)  # shares of a window at which poses are compared
# Errors of a good fit at the end of ten seconds: they weigh positions against rotations
POSITION, ROTATION = 0.5, 0.1  # m, rad
EVALUATIONS = 40  # of the residuals and their derivatives


def predict(transition: Transition, states: Any, controls: Float[Array, "batch time m"], dt: float | Array) -> Any:
    """Return the states that a transition predicts without noise, leading axes ``(batch, time)``.

    Args:
        transition: whose controls may be fewer than those of the log.
        states: at the start, leading axis batch.
        controls: of every step.
        dt: length of a step, s.
    """
    used = controls[..., : transition.controls]
    return jax.vmap(lambda state, us: transition.mean_path(state, us, dt))(states, used)


def fit_bias(nominal: Transition, data: Windows, dt: float) -> Transition:
    """Fit the biases of an IMU, or the offsets of a robot's commands."""
    if isinstance(nominal, Imu):
        free = lambda model: (model.constants.accel_bias, model.constants.gyro_bias)
        return _fit(CalibratedImu(ImuConstants.zero(), nominal), free, data, dt)
    return _fit(_uncalibrated(nominal), lambda model: (model.offset,), data, dt)


def fit_parametric(nominal: Transition, data: Windows, dt: float) -> Transition:
    """Fit biases, drag and lever arm of an IMU, or gains and offsets of a robot's commands."""
    if isinstance(nominal, Imu):
        return _fit(CalibratedImu(ImuConstants.zero(), nominal), lambda model: model.constants, data, dt)
    return _fit(_uncalibrated(nominal), lambda model: (model.gain, model.offset), data, dt)


def _uncalibrated(nominal: Transition) -> CalibratedDrive:
    return CalibratedDrive(nominal, jnp.eye(nominal.controls), jnp.zeros(nominal.controls))


def _fit(model: Any, free: Callable[[Any], Any], data: Windows, dt: float) -> Any:
    """Return the model with its free leaves at the least squares."""
    chosen = np.unique(np.linspace(0, len(data) - 1, min(len(data), FITTED_WINDOWS)).astype(int))
    some, (start, unravel) = data.take(chosen), jax.flatten_util.ravel_pytree(free(model))
    place = lambda constants: eqx.tree_at(free, model, unravel(constants))
    residuals = jax.jit(partial(_residuals, place, some, dt))
    # The constants are few, the residuals many: forward differentiation
    jacobian = jax.jit(jax.jacfwd(residuals))
    found = least_squares(
        lambda c: np.asarray(residuals(jnp.asarray(c, jnp.float32)), float),
        np.asarray(start, float),
        lambda c: np.asarray(jacobian(jnp.asarray(c, jnp.float32)), float),
        loss="soft_l1",
        max_nfev=EVALUATIONS,
    )
    return place(jnp.asarray(found.x, jnp.float32))


def _residuals(place: Callable[[Array], Transition], data: Windows, dt: float, constants: Array) -> Array:
    """Return the differences of predicted and measured poses at the horizons."""
    model, length = place(constants), data.controls.shape[1]
    at = jnp.asarray(sorted({max(1, round(share * length)) - 1 for share in COMPARED_AT}))
    start, after = (jax.tree.map(lambda a: a[:, part], data.states) for part in (0, slice(1, None)))
    path = predict(model, start, data.controls, dt)
    poses = [model.manifold.pose(jax.tree.map(lambda a: a[:, at], states)) for states in (path, after)]
    off = poses[0] - poses[1]
    positions, rotations = off[..., :3, 3] / POSITION, off[..., :3, :3] / (2.0**0.5 * ROTATION)
    return jnp.concatenate([positions.ravel(), rotations.ravel()])
