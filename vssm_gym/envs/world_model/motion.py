"""Move imagined robots by the model's transitions under the real environments' noise, many robots at once.

Holonomic: the mean of :class:`~vssm_gym.model.transition.planar.Planar` for the noisy execution of the command.

Car: the mean of :class:`~vssm_gym.model.transition.bicycle.Bicycle` for the servos' response to the command. A servo is
a first-order lag, ``v' = a + (v - a) exp(-dt / lag)``, with the set point ``a = gain u (1 + jitter e)``; the arc is
that of the mean speed and steering over the step. Gain and trim belong to the car and are drawn with the episode
(:mod:`vssm_gym.envs.robots.car_noise`). Not modelled: backlash, voltage droop, the servo's rate limit, and tyre slip.

Learned: a draw of :class:`~vssm_gym.model.transition.learned.LearnedTransition`, whose rest goes on from step to step.

A law says where a robot would come in free space (:class:`Aim`); what obstacles make of it is the same for all laws.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from vssm_gym.envs.world_model.collision_map import CollisionMap, disc_clearance, slide
from vssm_gym.geometry.car import Car
from vssm_gym.geometry.transforms import wrap_angle
from vssm_gym.model.transition.bicycle import Bicycle
from vssm_gym.model.transition.learned import LearnedTransition
from vssm_gym.model.transition.with_rest import RestState

SERVOS = 4  # numbers of a car's servos: speed, steering, gain, trim
STANDING_DRIVES, STOOD_FOR = 4096, 10.0  # drives of robots that stand, and for how long they have been told to, s
DISCS = 3  # along the car's middle that cover its footprint


class Aim(NamedTuple):
    """Hold where a law moves n robots in free space."""

    planar: Float[Array, "n 3"]  # x, y (m), heading (rad)
    drive: Float[Array, "n d"]  # inner state of the drive, of the law's own form


class Motion(NamedTuple):
    """Hold the result of one step of n robots."""

    planar: Float[Array, "n 3"]  # x, y (m), heading (rad)
    drive: Float[Array, "n d"]
    collision: Bool[Array, "n"]


def aim_by_servos(
    planar: Float[Array, "n 3"],
    command: Float[Array, "n 2"],
    servos: Float[Array, "n 4"],
    noise: Float[Array, "n 6"],
    normal: Float[Array, "n 2"],
    transition: Bicycle,
    dt: float,
) -> Aim:
    """Return the arc of a car whose servos, (speed m/s, steering rad, gain, trim rad), follow the command."""
    speed, steering, gain, trim = (servos[:, i] for i in range(4))
    aim_speed = gain * command[:, 0] * (1.0 + noise[:, 4] * normal[:, 0])
    aim_steering = command[:, 1] + trim + noise[:, 5] * normal[:, 1]
    speed, mean_speed = _follow(speed, aim_speed, noise[:, 0], dt)
    steering, mean_steering = _follow(steering, aim_steering, noise[:, 1], dt)
    aim = transition.mean(planar, jnp.stack([mean_speed, mean_steering], axis=-1), dt)
    return Aim(aim, jnp.stack([speed, steering, gain, trim], axis=-1))


def aim_by_learned(
    planar: Float[Array, "n 3"],
    command: Float[Array, "n m"],
    rest: Float[Array, "n r"],
    normal: Float[Array, "n d"],
    transition: LearnedTransition,
    dt: float,
) -> Aim:
    """Return a draw of the learned transition, with its noise; ``normal`` is one number for each of its errors."""
    step = transition.step(RestState(planar, rest), command, dt)
    drawn = transition.perturb_in_body_axes(step.mean, step.stds * normal)
    return Aim(drawn.body, drawn.rest)


def standing_drives(transition: LearnedTransition | None, dt: float) -> Float[Array, "draws d"]:
    """Draw inner states of the drive of a robot that stands: of a learned one, the rest after steps of zero command.

    The prior of a rest is that of a robot of whose motion nothing is known; one that has been told to rest for a while
    has another.
    """
    if transition is None:
        return jnp.zeros((1, SERVOS))
    by_rest, by_path = jax.random.split(jax.random.key(0))
    rest = jax.random.normal(by_rest, (STANDING_DRIVES, transition.rest))
    states = RestState(jnp.zeros((STANDING_DRIVES, 3)), rest)
    path = transition.sample_paths(by_path, states, jnp.zeros((round(STOOD_FOR / dt), transition.controls)), dt)
    return path.rest[:, -1]


def slide_disc(
    collision_map: CollisionMap, which: Int[Array, "n"], planar: Float[Array, "n 3"], aim: Aim, radius: float
) -> Motion:
    """Move discs of ``radius`` m to where they aim; they slide along obstacles."""
    x, y = planar[:, 0], planar[:, 1]
    x, y, collided = slide(collision_map, which, x, y, aim.planar[:, 0] - x, aim.planar[:, 1] - y, radius)
    return Motion(jnp.stack([x, y, aim.planar[:, 2]], axis=-1), aim.drive, collided)


def block_car(
    collision_map: CollisionMap,
    which: Int[Array, "n"],
    planar: Float[Array, "n 3"],
    aim: Aim,
    stopped: Float[Array, "n d"],
    car: Car,
) -> Motion:
    """Move cars to where they aim; one that would come to overlap an obstacle stays, its drive at ``stopped``."""
    before = car_clearance(collision_map, which, planar, car)
    after = car_clearance(collision_map, which, aim.planar, car)
    # A car that overlaps already (its start was drawn in another sample of the map) may leave.
    blocked = (after < 0.0) & (after < before)
    keep = lambda held, moved: jnp.where(blocked[:, None], held, moved)
    return Motion(keep(planar, aim.planar), keep(stopped, aim.drive), blocked)


def disc_radius(car: Car) -> float:
    """Return the radius of the discs that cover the footprint, m."""
    return float(((0.5 * car.length / DISCS) ** 2 + (0.5 * car.width) ** 2) ** 0.5)


def car_clearance(
    collision_map: CollisionMap, which: Int[Array, "n"], planar: Float[Array, "n 3"], car: Car
) -> Float[Array, "n"]:
    """Return the least clearance of the car's discs beyond their radius, m."""
    offsets = [car.center_forward + car.length * ((i + 0.5) / DISCS - 0.5) for i in range(DISCS)]
    along = jnp.asarray(offsets)[:, None]
    x = planar[:, 0] + along * jnp.cos(planar[:, 2])
    y = planar[:, 1] + along * jnp.sin(planar[:, 2])
    return disc_clearance(collision_map, which, x, y, disc_radius(car))


def _follow(now: Array, aim: Array, lag: Array, dt: float) -> tuple[Array, Array]:
    """Return a first-order servo's value after ``dt`` s, and its mean over that time."""
    safe = jnp.maximum(lag, 1e-6)
    left = jnp.exp(-dt / safe)
    return aim + (now - aim) * left, aim + (now - aim) * (1.0 - left) * safe / dt


def estimated_pose(planar: Float[Array, "n 3"], error: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return the pose estimate: the true pose moved by ``error`` = (forward m, left m, turn rad)."""
    c, s = jnp.cos(planar[:, 2]), jnp.sin(planar[:, 2])
    x = planar[:, 0] + c * error[:, 0] - s * error[:, 1]
    y = planar[:, 1] + s * error[:, 0] + c * error[:, 1]
    return jnp.stack([x, y, wrap_angle(planar[:, 2] + error[:, 2])], axis=-1)
