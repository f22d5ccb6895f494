"""Test that the error that an agent expects of its bicycle covers the errors that cars of each noise level make."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vssm_gym.envs.physics import MujocoCar
from vssm_gym.envs.robots.car_noise import NOISE_LEVELS, CarActuators, CarNoise
from vssm_gym.envs.scenes.scene import load_scene
from vssm_gym.envs.tasks.car import CarTaskSampler
from vssm_gym.eval.protocols.agent_context import transition_of
from vssm_gym.eval.protocols.car_model_error import car_model_error
from vssm_gym.geometry.car import Car
from vssm_gym.model.transition import PLANAR, planar_belief

CAR = Car()
SCENE = "procedural:101:small"  # of the training split; the numbers were fitted to seeds 0 to 7
IN_95 = 7.815  # chi^2 of three degrees of freedom


predict = jax.jit(lambda transition, belief, command: transition.predict(belief, command, CAR.dt))


def smooth(rng: np.random.Generator, steps: int) -> np.ndarray:
    """Return commands that change as a controller's: set points for 0.5 to 2 s, reached at limited rates."""
    commands, now, left, target = np.zeros((steps, 2)), np.zeros(2), 0, np.zeros(2)
    for k in range(steps):
        if left == 0:
            left = int(rng.integers(5, 20))
            target = np.array([rng.uniform(-0.6, 0.6), rng.uniform(-CAR.max_steering, CAR.max_steering)])
        left -= 1
        now = now + np.clip(target - now, (-0.2, -0.3), (0.2, 0.3))
        commands[k] = now
    return commands


def drives(noise: CarNoise, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return commands and poses of drives without a collision."""
    apartment = load_scene(SCENE)
    body, sampler, made = MujocoCar(apartment, CAR), CarTaskSampler.of(apartment, CAR), []
    for k in range(count):
        rng = np.random.default_rng(k)
        body.reset(np.array(sampler.draw(rng, "poses").start))
        actuators, poses, driven = CarActuators(noise, rng), [body.pose()], []
        for command in smooth(rng, 40):
            points, friction = actuators(np.full(2, command[0]), float(command[1]), CAR.dt)
            if body.drive(points, friction):
                break
            poses.append(body.pose())
            driven.append(command)
        made.append((np.array(driven), np.array(poses)))
    return made


@pytest.mark.slow
@pytest.mark.parametrize("level", NOISE_LEVELS)
def test_its_covariance_holds_the_errors_of_a_step_and_of_a_second(level):
    transition = transition_of(CAR, NOISE_LEVELS[level])
    for horizon in (1, 10):
        distances = []
        for commands, poses in drives(NOISE_LEVELS[level], 12):
            for first in range(5, len(commands) - horizon + 1, 5):
                belief = planar_belief(jnp.asarray(poses[first], jnp.float32), 1e-10 * jnp.eye(3))
                for command in commands[first : first + horizon]:
                    belief = predict(transition, belief, jnp.asarray(command, jnp.float32))
                error = np.asarray(PLANAR.error(belief.mean, jnp.asarray(poses[first + horizon], jnp.float32)))
                distances.append(error @ np.linalg.solve(np.asarray(belief.covariance), error))
        inside = np.mean(np.array(distances) < IN_95)
        assert len(distances) > 40
        assert inside > 0.85, (horizon, inside)  # 95 % but for chance: errors of one drive go together
        assert np.mean(distances) > 0.3, (horizon, np.mean(distances))  # 3 if exact: it may not be far too wide


def test_more_noise_is_a_larger_error():
    stds = np.array(
        [
            [getattr(car_model_error(noise), name) for name in car_model_error(noise).__dataclass_fields__]
            for noise in NOISE_LEVELS.values()
        ]
    )
    assert (np.diff(stds, axis=0) >= 0.0).all() and (np.diff(stds[:, :2], axis=0) > 0.0).all()
