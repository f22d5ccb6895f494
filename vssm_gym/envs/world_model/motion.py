"""How imagined robots move: the model's transitions under the real environments' noise, many robots at once.

Holonomic: the mean of :class:`~vssm_gym.model.transition.planar.Planar` for the control that its noise makes of the
command.

Car: the mean of :class:`~vssm_gym.model.transition.bicycle.Bicycle` for what servos make of the command. A servo lags,
``v' = a + (v - a) exp(-dt / lag)``, after ``a = gain u (1 + jitter e)``; the arc is that of the mean over the step.
Gain and trim are the car's own, drawn with the episode (:mod:`vssm_gym.envs.robots.car_noise`). Left out, and so part
of what imagination misses: backlash, droop, the servo's fastest rate, and tyres that slip.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.envs.world_model.collision_map import Ground, fits, slide
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.bicycle import Bicycle
from vssm_gym.model.transition.planar import Planar

# The car's footprint as discs along its middle, each over a third of its length
DISCS = 3


class Moved(NamedTuple):
    """After one step of n robots."""

    planar: Float[Array, "n 3"]  # x, y (m), heading (rad)
    servos: Float[Array, "n 4"]  # of a car: speed (m/s), steering (rad), gain, trim (rad)
    collision: Bool[Array, "n"]


def drive_holonomic(
    ground: Ground,
    which: Int[Array, "n"],
    planar: Float[Array, "n 3"],
    command: Float[Array, "n 3"],
    transition: Planar,
    normal: Float[Array, "n 2"],
    radius: float,
) -> Moved:
    """One step of discs of ``radius`` m that slide along what they meet."""
    aim = transition.executed(planar, command, normal)
    x, y = planar[:, 0], planar[:, 1]
    x, y, touched = slide(ground, which, x, y, aim[:, 0] - x, aim[:, 1] - y, radius)
    return Moved(jnp.stack([x, y, aim[:, 2]], axis=-1), jnp.zeros((*x.shape, 4)), touched)


def drive_car(
    ground: Ground,
    which: Int[Array, "n"],
    planar: Float[Array, "n 3"],
    command: Float[Array, "n 2"],
    servos: Float[Array, "n 4"],
    noise: Float[Array, "n 6"],
    normal: Float[Array, "n 2"],
    transition: Bicycle,
    car: Car,
) -> Moved:
    """One step of cars; one that would come to overlap an obstacle stays where it is, and its speed is gone."""
    speed, steering, gain, trim = (servos[:, i] for i in range(4))
    aim_speed = gain * command[:, 0] * (1.0 + noise[:, 4] * normal[:, 0])
    aim_steering = command[:, 1] + trim + noise[:, 5] * normal[:, 1]
    speed, mean_speed = _follow(speed, aim_speed, noise[:, 0], car.dt)
    steering, mean_steering = _follow(steering, aim_steering, noise[:, 1], car.dt)
    aim = transition.mean(planar, jnp.stack([mean_speed, mean_steering], axis=-1), car.dt)
    before, after = room(ground, which, planar, car), room(ground, which, aim, car)
    # One that overlaps already (a start in another sample of the map) may leave.
    blocked = (after < 0.0) & (after < before)
    planar = jnp.where(blocked[:, None], planar, aim)
    servos = jnp.stack([jnp.where(blocked, 0.0, speed), steering, gain, trim], axis=-1)
    return Moved(planar, servos, blocked)


def disc_radius(car: Car) -> float:
    """Of each of the discs that cover the footprint, m."""
    return float(((0.5 * car.length / DISCS) ** 2 + (0.5 * car.width) ** 2) ** 0.5)


def room(ground: Ground, which: Int[Array, "n"], planar: Float[Array, "n 3"], car: Car) -> Float[Array, "n"]:
    """Clearance of the car's discs beyond their radius, m."""
    offsets = [car.center_forward + car.length * ((i + 0.5) / DISCS - 0.5) for i in range(DISCS)]
    along = jnp.asarray(offsets)[:, None]
    x = planar[:, 0] + along * jnp.cos(planar[:, 2])
    y = planar[:, 1] + along * jnp.sin(planar[:, 2])
    return fits(ground, which, x, y, disc_radius(car))


def _follow(now: Array, aim: Array, lag: Array, dt: float) -> tuple[Array, Array]:
    """A first-order servo after ``dt`` s, and its mean until then."""
    safe = jnp.maximum(lag, 1e-6)
    left = jnp.exp(-dt / safe)
    return aim + (now - aim) * left, aim + (now - aim) * (1.0 - left) * safe / dt


def believed(planar: Float[Array, "n 3"], error: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """The estimated pose: the true one moved by ``error`` = (forward m, left m, turn rad)."""
    c, s = jnp.cos(planar[:, 2]), jnp.sin(planar[:, 2])
    x = planar[:, 0] + c * error[:, 0] - s * error[:, 1]
    y = planar[:, 1] + s * error[:, 0] + c * error[:, 1]
    return jnp.stack([x, y, wrap_angle(planar[:, 2] + error[:, 2])], axis=-1)
