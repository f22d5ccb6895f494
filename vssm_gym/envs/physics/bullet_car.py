"""Simulate the car as a multi-body in PyBullet: the second simulator, with a solver and a drive of its own.

Where MuJoCo's car has an open differential, each rear wheel has a motor here that holds the speed of the Ackermann
geometry (an electronic differential). Contacts are solved by sequential impulses. Dimensions, masses and boxes are the
same. No other module imports PyBullet, which is the extra ``bullet``.
"""

import math
import weakref
from typing import Any

import numpy as np
from jaxtyping import Float

from vssm_gym.envs.physics import obstacles
from vssm_gym.envs.robots.car_body import BODY, DYNAMICS, TYRES, ackermann
from vssm_gym.envs.robots.car_noise import TICK
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.car import Car

STEERING_TORQUE = 4.0  # N m, largest of the steering servo
FLOOR, BOXES = 4, 8  # collision bits of what tyres and chassis meet
STEERING_GAIN = 0.5  # fraction of the steering's error that its servo corrects in a substep
_HUB_MASS = 0.01  # kg, of the part that turns with the steering, without the wheel
_SETTLE = 20  # substeps at rest after which the tyres carry the car


class BulletCar:
    """Simulate a :class:`~vssm_gym.envs.robots.car_body.CarBody` in PyBullet, in one DIRECT client, for one thread.

    Every :meth:`reset` rebuilds the client's world, so that nothing of an episode is left in the solver's caches. A
    pickled car continues from the same poses and velocities up to rounding, since those caches are not part of its
    state.
    """

    reads_contacts = True  # keep contacts for :meth:`contact_bearings`
    _bearings: list[float]  # of obstacles hit in the last drive, rad

    def __init__(self, apartment: Apartment, car: Car) -> None:
        self.apartment, self.car = apartment, car
        boxes = apartment.boxes()
        self._solid = [boxes[i] for i in obstacles(boxes, car.height)]
        self._connect()
        self.reset(np.zeros(3))

    def _connect(self) -> None:
        try:
            import pybullet
        except ImportError as error:
            expected = (
                "the extra `bullet` to be installed (pip install -c constraints.txt '.[bullet]'), or physics='mujoco'"
            )
            raise InputError("environment", "physics", expected) from error
        self._bullet = pybullet
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise InputError("environment", "physics", "fewer PyBullet simulations in one process: no more start")
        self._finalizer = weakref.finalize(self, pybullet.disconnect, self._client)

    def __getstate__(self) -> dict[str, Any]:
        p, client = self._bullet, self._client
        return {
            "apartment": self.apartment,
            "car": self.car,
            "base": p.getBasePositionAndOrientation(self._body, physicsClientId=client),
            "velocity": p.getBaseVelocity(self._body, physicsClientId=client),
            "joints": [p.getJointState(self._body, j, physicsClientId=client)[:2] for j in range(6)],
            "bearings": self._bearings,
            "reads_contacts": self.reads_contacts,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["apartment"], state["car"])  # type: ignore[misc]
        p, client = self._bullet, self._client
        p.resetBasePositionAndOrientation(self._body, *state["base"], physicsClientId=client)
        p.resetBaseVelocity(self._body, *state["velocity"], physicsClientId=client)
        for j, (angle, speed) in enumerate(state["joints"]):
            p.resetJointState(self._body, j, angle, speed, physicsClientId=client)
        self._bearings, self.reads_contacts = state["bearings"], state["reads_contacts"]

    def reset(self, planar: PlanarPose) -> None:
        """Place the rear axle at ``(x, y, heading)``, m and rad, at rest."""
        p, client = self._bullet, self._client
        p.resetSimulation(physicsClientId=client)
        self._bearings = []
        p.setGravity(0.0, 0.0, -9.81, physicsClientId=client)
        p.setPhysicsEngineParameter(
            fixedTimeStep=DYNAMICS.substep,
            numSolverIterations=60,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        floor = p.createCollisionShape(p.GEOM_PLANE, physicsClientId=client)
        self._floor = p.createMultiBody(0.0, floor, physicsClientId=client)
        p.changeDynamics(self._floor, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
        self._collides(self._floor, -1, FLOOR, TYRES)
        self._names: dict[int, str] = {}
        for box in self._solid:
            # Upright prisms: the floor's motion meets vertical faces only.
            half = [0.5 * box.size[0], 0.5 * box.size[1], 0.5 * self.car.height + 1.0]
            shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half, physicsClientId=client)
            at, turned = (*box.center[:2], 0.5 * self.car.height), p.getQuaternionFromEuler((0.0, 0.0, box.yaw))
            body = p.createMultiBody(0.0, shape, -1, at, turned, physicsClientId=client)
            p.changeDynamics(body, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)
            self._collides(body, -1, BOXES, BODY)
            self._names[body] = box.name
        self._build_car(planar)
        self._hold(0.0, 0.0)
        for _ in range(_SETTLE):
            p.stepSimulation(physicsClientId=client)
        self._place(planar)

    def _build_car(self, planar: PlanarPose) -> None:
        """Build the chassis and its links.

        Hub and wheel of each front wheel (0 to 3), then the rear wheels (4, 5), left first.
        """
        p, client, car = self._bullet, self._client, self.car
        tall = car.height - DYNAMICS.clearance
        # The base's frame is its centre of mass, low between the axles as in MuJoCo.
        self._centre = np.array([0.5 * car.wheelbase, 0.0, DYNAMICS.clearance + tall / 6.0])
        middle = [car.center_forward - self._centre[0], 0.0, DYNAMICS.clearance + 0.5 * tall - self._centre[2]]
        half = [0.5 * car.length, 0.5 * car.width, 0.5 * tall]
        shape = p.createCollisionShape(
            p.GEOM_BOX, halfExtents=half, collisionFramePosition=middle, physicsClientId=client
        )
        wheel = p.createCollisionShape(p.GEOM_SPHERE, radius=car.wheel_radius, physicsClientId=client)
        positions: list[list[float]] = []
        parents: list[int] = []
        axes, masses, shapes = [], [], []
        for side in (1.0, -1.0):
            at = np.array([car.wheelbase, side * 0.5 * car.track, car.wheel_radius]) - self._centre
            positions += [at.tolist(), [0.0, 0.0, 0.0]]
            parents += [0, len(parents) + 1]  # counted from 1; 0 is the base
            axes += [[0, 0, 1], [0, 1, 0]]
            masses += [_HUB_MASS, DYNAMICS.wheel_mass - _HUB_MASS]
            shapes += [-1, wheel]
        for side in (1.0, -1.0):
            at = np.array([0.0, side * 0.5 * car.track, car.wheel_radius]) - self._centre
            positions.append(at.tolist())
            parents.append(0)
            axes.append([0, 1, 0])
            masses.append(DYNAMICS.wheel_mass)
            shapes.append(wheel)
        n = len(positions)
        self._body = p.createMultiBody(
            baseMass=DYNAMICS.chassis_mass,
            baseCollisionShapeIndex=shape,
            basePosition=self._centre.tolist(),
            linkMasses=masses,
            linkCollisionShapeIndices=shapes,
            linkVisualShapeIndices=[-1] * n,
            linkPositions=positions,
            linkOrientations=[[0.0, 0.0, 0.0, 1.0]] * n,
            linkInertialFramePositions=[[0.0, 0.0, 0.0]] * n,
            linkInertialFrameOrientations=[[0.0, 0.0, 0.0, 1.0]] * n,
            linkParentIndices=parents,
            linkJointTypes=[p.JOINT_REVOLUTE] * n,
            linkJointAxis=axes,
            physicsClientId=client,
        )
        x, y, z = car.length, car.width, tall / 3.0
        inertia = [DYNAMICS.chassis_mass / 12.0 * moment for moment in (y * y + z * z, x * x + z * z, x * x + y * y)]
        quiet = {"linearDamping": 0.0, "angularDamping": 0.0, "restitution": 0.0, "physicsClientId": client}
        p.changeDynamics(
            self._body, -1, lateralFriction=DYNAMICS.bumper_friction, localInertiaDiagonal=inertia, **quiet
        )
        disc = 0.5 * DYNAMICS.wheel_mass * car.wheel_radius**2
        for j in range(n):
            spin = [0.5 * disc, disc, 0.5 * disc]
            p.changeDynamics(self._body, j, localInertiaDiagonal=spin, jointDamping=0.0, **quiet)
            self._collides(self._body, j, TYRES, FLOOR)
        self._collides(self._body, -1, BODY, BOXES)
        for j in (1, 3):  # the front wheels roll freely
            p.setJointMotorControl2(self._body, j, p.VELOCITY_CONTROL, force=0.0, physicsClientId=client)
        self._torque = 0.5 * DYNAMICS.mass * DYNAMICS.max_acceleration * car.wheel_radius
        self._place(planar)

    def _collides(self, body: int, link: int, group: int, mask: int) -> None:
        self._bullet.setCollisionFilterGroupMask(body, link, group, mask, physicsClientId=self._client)

    def _place(self, planar: PlanarPose) -> None:
        p, client = self._bullet, self._client
        x, y, heading = (float(v) for v in planar)
        c, s = math.cos(heading), math.sin(heading)
        at = (x + c * self._centre[0], y + s * self._centre[0], float(self._centre[2]))
        p.resetBasePositionAndOrientation(
            self._body, at, (0.0, 0.0, math.sin(0.5 * heading), math.cos(0.5 * heading)), physicsClientId=client
        )
        p.resetBaseVelocity(self._body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=client)
        for j in range(6):
            p.resetJointState(self._body, j, 0.0, 0.0, physicsClientId=client)

    def _hold(self, speed: float, steering: float) -> None:
        """Pass the set points to the motors."""
        p, client, car = self._bullet, self._client, self.car
        for j, angle in zip((0, 2), ackermann(steering, car), strict=True):
            p.setJointMotorControl2(
                self._body,
                j,
                p.POSITION_CONTROL,
                targetPosition=angle,
                positionGain=STEERING_GAIN,
                force=STEERING_TORQUE,
                physicsClientId=client,
            )
        inward = 0.5 * car.track * math.tan(steering) / car.wheelbase
        for j, share in ((4, 1.0 - inward), (5, 1.0 + inward)):
            p.setJointMotorControl2(
                self._body,
                j,
                p.VELOCITY_CONTROL,
                targetVelocity=share * speed / car.wheel_radius,
                force=self._torque,
                physicsClientId=client,
            )

    def drive(self, points: Float[np.ndarray, "ticks 2"], friction: float) -> tuple[str, ...]:
        """Follow ``(speed, steering)`` set points, one per TICK.

        Return the names of the obstacles hit, in the boxes' order.
        """
        p, client = self._bullet, self._client
        for j in (1, 3, 4, 5):
            p.changeDynamics(self._body, j, lateralFriction=friction, physicsClientId=client)
        collided: set[int] = set()
        self._bearings = []
        for speed, steering in points.tolist():
            self._hold(speed, steering)
            for _ in range(round(TICK / DYNAMICS.substep)):
                p.stepSimulation(physicsClientId=client)
                for contact in p.getContactPoints(self._body, linkIndexA=-1, physicsClientId=client):
                    if contact[8] <= 0.0:  # the distance: Bullet keeps points before they are in contact
                        collided.add(contact[2])
                        if self.reads_contacts:
                            _, rotation = self._where()
                            outwards = -np.array(contact[7]) @ rotation  # the normal points to the chassis
                            self._bearings.append(math.atan2(outwards[1], outwards[0]))
        return tuple(dict.fromkeys(self._names[body] for body in sorted(collided)))

    def contact_bearings(self) -> Float[np.ndarray, "n"]:
        """Return the directions of the obstacles in contact during the last :meth:`drive`, rad, from body x."""
        return np.array(self._bearings)

    def pose(self) -> PlanarPose:
        """Return the rear axle's ``(x, y, heading)``, m and rad, heading in [-pi, pi); float64 ``(3,)``."""
        (x, y, _), rotation = self._where()
        at = rotation @ self._centre
        heading = math.atan2(rotation[1, 0], rotation[0, 0])
        return np.array([x - at[0], y - at[1], heading if heading < math.pi else -math.pi])

    def speed(self) -> float:
        """Return the speed of the rear axle along the heading, m/s."""
        (vx, vy, _), _ = self._bullet.getBaseVelocity(self._body, physicsClientId=self._client)
        heading = self.pose()[2]
        return math.cos(heading) * vx + math.sin(heading) * vy

    def upright(self) -> bool:
        """Return True if the car can drive: its tilt is below 45 degrees and it is on the floor."""
        (_, _, z), rotation = self._where()
        height = z - float(rotation[2] @ self._centre)
        return bool(rotation[2, 2] > math.sqrt(0.5) and abs(height) < self.car.wheel_radius)

    def _where(self) -> tuple[tuple[float, float, float], np.ndarray]:
        at, turned = self._bullet.getBasePositionAndOrientation(self._body, physicsClientId=self._client)
        return at, np.array(self._bullet.getMatrixFromQuaternion(turned)).reshape(3, 3)

    def close(self) -> None:
        """Disconnect the client; the car cannot be used afterwards."""
        self._finalizer()
