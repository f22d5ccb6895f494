"""Express parts of IPOPT's problem in CasADi's symbols: the bicycle's step, and interpolating splines.

CasADi itself is imported in one place, :mod:`vssm_gym.planning.mpc.ipopt`, and given to these functions.
"""

from typing import Any

from vssm_gym.planning.mpc.windows import SUPPORT


def bicycle_step(ca: Any, states: Any, controls: Any, dt: float, wheelbase: float) -> Any:
    """Return states a step later, ``(3, n)`` symbols: CasADi's twin of :meth:`vssm_gym.model.transition.Bicycle.mean`.

    Args:
        ca: the module ``casadi``.
        states: ``(3, n)`` x, y (m), heading (rad); the heading is not wrapped.
        controls: ``(2, n)`` speed (m/s), steering (rad).
        dt: length of the step, s.
        wheelbase: of the car, m.
    """

    def sinc(a):
        near = ca.fabs(a) < 0.1
        safe = ca.if_else(near, 1.0, a)
        return ca.if_else(near, 1.0 - a**2 / 6.0 * (1.0 - a**2 / 20.0), ca.sin(safe) / safe)

    length = controls[0, :] * dt
    turn = length * ca.tan(controls[1, :]) / wheelbase
    forward, left = length * sinc(turn), length * 0.5 * turn * sinc(0.5 * turn) ** 2
    c, s = ca.cos(states[2, :]), ca.sin(states[2, :])
    return states + ca.vertcat(c * forward - s * left, s * forward + c * left, turn)


def spline(ca: Any, coefficients: Any, shape: tuple[int, ...], places: list[Any]) -> Any:
    """Return the cubic B-spline at ``places`` (rows ``(1, n)`` of cell coordinates, one a dimension), ``(1, n)``.

    Beyond the window the place nearest to it. The indices are piecewise constant, so derivatives pass by them.
    """
    indices, weights = [], []
    for g, n in zip(places, shape, strict=True):
        g = ca.fmin(ca.fmax(g, 1.0), n - 2.0 - 1e-9)
        below = ca.floor(g)
        t = g - below
        indices.append([below - 1.0 + k for k in range(SUPPORT)])
        r = 1.0 - t
        inner = lambda a: (4.0 - 6.0 * a**2 + 3.0 * a**3) / 6.0
        weights.append([r**3 / 6.0, inner(t), inner(r), t**3 / 6.0])
    flat, weight = indices[0], weights[0]
    for k in range(1, len(shape)):
        flat = [shape[k] * i + j for i in flat for j in indices[k]]
        weight = [a * b for a in weight for b in weights[k]]
    picked = coefficients[ca.vec(ca.vertcat(*flat))]
    return ca.sum1(ca.reshape(picked, len(flat), places[0].shape[1]) * ca.vertcat(*weight))
