"""Generate a hand-held camera's walk through an apartment: a smooth 6-DoF path over free floor, from room to room.

    position = (x, y) of a person who walks 0.3-0.6 m/s on shortest paths; about 1.3 m up
    yaw      = the direction of walking, with small looks to the sides;  pitch, roll = small slow oscillations

An upright cylinder around the camera, as high as a person, collides with nothing along the path, so that the camera
never passes through walls or furniture. It stops to turn at sharp corners and looks mostly ahead.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import Apartment
from vssm_gym.envs.tasks.geodesic import Geodesics
from vssm_gym.errors import InputError
from vssm_gym.geometry.transforms import R_BODY_CAM

PERSON = 1.8  # m, height of the body for collisions
BODIES = (0.35, 0.3, 0.25, 0.2, 0.15, 0.1)  # m, radii tried in this order: the first that cuts off no room is used
SPEED_RANGE = (0.3, 0.6)  # m/s of the slowest and the fastest stretch
TURN_RATE = 0.6  # rad/s of a turn on the spot, before smoothing
SMOOTHING = 0.35  # s, standard deviation of the Gaussian that rounds corners
PATH_MARGIN = 0.05  # m, clearance of planned paths beyond the body, because smoothing cuts corners
HELD_HEIGHT, HELD_LIFT = 1.3, 0.15  # m of the camera above the floor, and how far it rises and falls
YAW_SWING, PITCH_SWING, ROLL_SWING = np.radians([18.0, 7.0, 4.0])  # rad that yaw, pitch and roll swing
LOOK_DOWN = np.radians(10.0)  # rad that the camera looks down
TREMOR = (0.004, np.radians(0.4))  # m and rad of unsteady hands
PATH_SAMPLES = 100  # samples a second, at least, that the path is planned with
ROOM_PLACES = 12  # random places in a room, of which the roomiest is visited


@dataclass(frozen=True)
class Walk:
    """Hold the camera poses of a walk."""

    times: Float[np.ndarray, "n"]  # s, from 0
    T_world_cam: Float[np.ndarray, "n 4 4"]  # m
    body: float  # m, radius of the collision-free upright cylinder around the camera


def walk(apartment: Apartment, metres: float, rate: float, seed: int = 0) -> Walk:
    """Generate a camera path of at least ``metres`` through all rooms, repeatedly in random order.

    Args:
        apartment: the scene; rooms that are cut off are left out.
        metres: length of the camera's path, sampled at ``rate``.
        rate: poses a second.
        seed: of the order, the places, the speed and the unsteadiness.

    Raises:
        InputError: no room to walk in, or impossible numbers.
    """
    if not 0.0 < metres < np.inf:
        raise InputError("hand-held camera", "metres", f"a length above 0, not {metres}")
    if not 0.0 < rate <= PATH_SAMPLES:
        raise InputError("hand-held camera", "rate", f"frames a second in (0, {PATH_SAMPLES}], not {rate}")
    rng = np.random.default_rng(seed)
    space, body = _floor(apartment)
    free = space.widened(-PATH_MARGIN)
    geodesics = Geodesics(space)
    swings = _Swings(rng)
    places = _room_to_room(space, rng)
    corners = [next(places)]
    while True:
        # Some rooms at a time: the length of the walk is known only from its poses.
        for place in itertools.islice(places, 2 * len(space.rooms)):
            corners.extend(geodesics.path(corners[-1], place)[1:])
        times, poses = _poses(np.array(corners), free, rate, swings)
        length = np.cumsum(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1))
        if length[-1] >= metres:
            end = int(np.searchsorted(length, metres)) + 2
            return Walk(times[:end], poses[:end], body)


def _floor(apartment: Apartment) -> tuple[FreeSpace, float]:
    """Return the free space of paths, and the largest body radius that cuts off no more rooms than the smallest."""
    slim = FreeSpace.from_apartment(apartment, BODIES[-1] + PATH_MARGIN, PERSON)
    for radius in BODIES[:-1]:
        try:
            space = slim.widened(radius - BODIES[-1])
        except InputError:
            continue
        if set(space.cut_off_rooms()) <= set(slim.cut_off_rooms()):
            return space, radius
    return slim, BODIES[-1]


def _room_to_room(space: FreeSpace, rng: np.random.Generator) -> Iterator[Float[np.ndarray, "2"]]:
    """Yield endless places (2,): the rooms in random order, in each the roomiest of some random places."""
    rooms = [room for name, room in space.rooms.items() if name not in space.cut_off_rooms()]
    while True:
        for i in rng.permutation(len(rooms)):
            area = shapely.intersection(rooms[i], space.largest)
            shapely.prepare(area)
            low, high = np.split(np.array(area.bounds), 2)
            found = np.zeros((0, 2))
            while len(found) < ROOM_PLACES:
                block = rng.uniform(low, high, (256, 2))
                found = np.concatenate([found, block[shapely.contains_xy(area, block)]])[:ROOM_PLACES]
            yield found[np.argmax(space.distance_to_obstacle(found))]


class _Swings:
    """Sum sines of incommensurate periods and random phases: slow oscillations of unit amplitude."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._phases = rng.uniform(0.0, 2.0 * np.pi, (12, 3))

    def __call__(self, channel: int, t: Float[np.ndarray, "n"], period: float) -> Float[np.ndarray, "n"]:
        """Return values in [-1, 1]; ``period`` s is that of the slowest sine."""
        periods = period / np.array([1.0, 1.37, 1.83])
        return np.mean(np.sin(2.0 * np.pi * t[:, None] / periods + self._phases[channel]), axis=1)


def _poses(
    corners: Float[np.ndarray, "m 2"], free: FreeSpace, rate: float, swings: _Swings
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 4 4"]]:
    """Return times and T_world_cam of a walk along a chain of straight lines."""
    every = math.ceil(PATH_SAMPLES / rate)
    fine = every * rate  # samples a second
    clock, knots, progress, facing, along = _pace(corners, fine, swings)
    t = np.arange(len(clock)) / fine
    s = np.interp(clock, knots, progress)
    rough = np.stack([np.interp(s, along, corners[:, a]) for a in range(2)], axis=1)
    sway = TREMOR[0] * np.stack([swings(a, t, 1.1) for a in (1, 2)], axis=1)
    width = SMOOTHING * fine
    xy = gaussian_filter1d(rough, width, axis=0, mode="nearest") + sway
    while not free.contains(xy).all():  # terminates: the unsmoothed path has a clearance of PATH_MARGIN
        width *= 0.5
        xy = gaussian_filter1d(rough, width, axis=0, mode="nearest") + sway
    yaw = gaussian_filter1d(np.interp(clock, knots, facing), SMOOTHING * fine, mode="nearest")
    yaw += YAW_SWING * swings(3, t, 11.0)
    z = HELD_HEIGHT + HELD_LIFT * swings(4, t, 7.0) + TREMOR[0] * swings(5, t, 0.9)
    pitch = LOOK_DOWN + PITCH_SWING * swings(6, t, 6.0) + TREMOR[1] * swings(7, t, 1.0)
    roll = ROLL_SWING * swings(8, t, 5.0) + TREMOR[1] * swings(9, t, 1.3)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1)).as_matrix() @ R_BODY_CAM
    poses[:, :2, 3], poses[:, 2, 3] = xy, z
    return t[::every], poses[::every]


def _pace(corners: Float[np.ndarray, "m 2"], fine: float, swings: _Swings) -> tuple[np.ndarray, ...]:
    """Return path length and heading over time, both linear between knots.

    Returns:
        ``clock`` at every sample, in s of a walk of constant speed; at its ``knots``: path length in m and heading in
        rad; and the path length in m at every corner.
    """
    away = np.diff(corners, axis=0)
    leg = np.linalg.norm(away, axis=1)
    heading = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    mean = 0.5 * sum(SPEED_RANGE)
    # Knots: arrive at a corner, turn there, leave it.
    spent = np.stack([leg / mean, np.append(np.abs(np.diff(heading)) / TURN_RATE, 0.0)], axis=1).ravel()
    knots = np.concatenate([[0.0], np.cumsum(spent)])
    along = np.concatenate([[0.0], np.cumsum(leg)])
    progress = np.concatenate([[0.0], np.repeat(along[1:], 2)])
    facing = np.concatenate([np.repeat(heading, 2), heading[-1:]])
    t = np.arange(0.0, knots[-1] * mean / SPEED_RANGE[0], 1.0 / fine)
    clock = np.cumsum(1.0 + (SPEED_RANGE[1] / mean - 1.0) * swings(0, t, 9.0)) / fine
    return clock[clock < knots[-1]], knots, progress, facing, along
