"""Test that controllers take any transition of planar poses, by default the car's bicycle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from tests.helpers import mpc_worlds as worlds
from vssm_gym.errors import InputError
from vssm_gym.geometry.car import Car
from vssm_gym.model.transition import Bicycle, Rigid, Transition
from vssm_gym.model.transition.manifold import PLANAR
from vssm_gym.planning.mpc import objective, safety
from vssm_gym.planning.mpc.ipopt import Ipopt
from vssm_gym.planning.mpc.mppi import Mppi, MppiConfig
from vssm_gym.planning.mpc.problem import MpcConfig, MpcProblem
from vssm_gym.planning.mpc.random_search import RandomSearch, RandomSearchConfig

CONFIG = MpcConfig(horizon=15, deadline=float("inf"), proximity=0.0)


class Unicycle(Transition):
    """Move a body that turns in place; controls (..., 2) = (speed m/s, turn rate in units of ``rate`` rad/s)."""

    rate: float = 4.0

    manifold = PLANAR
    controls = 2
    commanded = True

    def mean(self, state: Array, control: Array, dt: float | Array) -> Array:
        turn, s = self.rate * control[..., 1] * dt, control[..., 0] * dt
        middle = state[..., 2] + 0.5 * turn
        return jnp.stack(
            [state[..., 0] + s * jnp.cos(middle), state[..., 1] + s * jnp.sin(middle), middle + 0.5 * turn], -1
        )

    def noise_covariance(self, state: Array, control: Array, dt: float | Array) -> Array:
        return 1e-4 * dt * jnp.eye(3)


class WithArray(Unicycle):
    table: Array = eqx.field(default_factory=lambda: jnp.zeros(3))


def test_by_default_the_cars_own_bicycle():
    problem = MpcProblem(Car(wheelbase=0.2), CONFIG)
    assert isinstance(problem.motion, Bicycle)
    assert problem.motion.wheelbase == 0.2
    assert problem == MpcProblem(Car(wheelbase=0.2), CONFIG)
    assert hash(problem) == hash(MpcProblem(Car(wheelbase=0.2), CONFIG))
    assert problem != MpcProblem(Car(wheelbase=0.2), CONFIG, Unicycle())
    assert MpcProblem(config=CONFIG, transition=Unicycle(3.0)) != MpcProblem(config=CONFIG, transition=Unicycle(4.0))


@pytest.mark.parametrize("transition", [Bicycle(), Unicycle()], ids=["bicycle", "unicycle"])
def test_a_path_is_the_mean_step_by_step(transition):
    """A transition's own ``mean_path`` and the default agree, for one sequence of controls and for a batch of them."""
    rng = np.random.default_rng(0)
    problem = MpcProblem(config=CONFIG, transition=transition)
    with jax.enable_x64(True):
        controls = jnp.asarray(rng.uniform(-1.0, 1.0, (2, 3, 15, 2)) * problem.car.limits)
        state = jnp.asarray([0.4, -0.7, 2.9])
        found = objective.rollout(problem, state, controls)
        default = Transition.mean_path(transition, state, controls, problem.car.dt)
        z = jnp.broadcast_to(state, (2, 3, 3))
        for t in range(15):
            z = transition.mean(z, controls[:, :, t], problem.car.dt)
            for path in (found, default):
                np.testing.assert_allclose(path[:, :, t, :2], z[..., :2], atol=1e-9)
                np.testing.assert_allclose(np.exp(1j * path[:, :, t, 2]), np.exp(1j * z[..., 2]), atol=1e-9)
        one = objective.rollout(problem, state, controls[1, 2])
        np.testing.assert_allclose(one, found[1, 2], atol=1e-12)


@pytest.mark.parametrize("make", ["random search", "mppi"])
def test_a_body_that_can_turn_in_place_does(make):
    """With a cost of heading only, the plan ends at the best heading, further than a car turns in that time."""
    problem = MpcProblem(config=CONFIG, transition=Unicycle())
    solver = {
        "random search": lambda: RandomSearch(problem, RandomSearchConfig(candidates=256)),
        "mppi": lambda: Mppi(problem, MppiConfig(samples=256)),
    }[make]()
    value = worlds.value_of(lambda x, y, h: 5.0 + 3.0 * np.abs(worlds.wrapped(h - 2.5)))
    clearance = worlds.clearance_of(lambda x, y: 1.9)
    warm = None
    for _ in range(6):
        warm = solver.plan(np.zeros(3), value, clearance, warm, np.zeros(2))
    assert warm is not None
    assert warm.usable
    car = problem.car
    assert CONFIG.horizon * car.dt * car.max_speed / car.turning_radius < 2.1
    assert warm.states[-1, 2] == pytest.approx(2.5, abs=0.1)
    expected = objective.rollout(problem, jnp.zeros(3), jnp.asarray(warm.controls, jnp.float32))
    np.testing.assert_allclose(warm.states[1:], expected, atol=1e-5)
    _, action = safety.step(problem, safety.init(np.zeros(2)), warm.within_deadline(0.0), np.zeros(3), clearance)
    assert action.kind is safety.SafeKind.HELD


@pytest.mark.parametrize("transition", [Rigid(), WithArray()], ids=["not planar", "not hashable"])
def test_a_transition_that_does_not_fit_is_an_error(transition):
    with pytest.raises(InputError, match="transition"):
        MpcProblem(config=CONFIG, transition=transition)


def test_ipopt_takes_the_bicycle_only():
    problem = MpcProblem(config=CONFIG, transition=Unicycle())
    with pytest.raises(InputError, match="Bicycle"):
        Ipopt(problem)
