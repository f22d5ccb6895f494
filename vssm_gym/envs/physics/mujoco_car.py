"""Simulate the car as rigid bodies in MuJoCo: a chassis on four wheels, the rear two driven by an open differential.

The chassis is a box over the footprint and collides with obstacles; the tyres roll on the floor. Tyres are thin
ellipsoids, so that each meets the floor in one point below its hub. Steering angles of the front wheels follow
Ackermann: their axes meet in a point on the rear axle's line.
"""

import math
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.physics.boxes import bearings, boxes_of_geoms, fixed_box
from vssm_gym.envs.physics.floor_world import obstacles
from vssm_gym.envs.robots.car_body import BODY, DYNAMICS, TYRES, ackermann
from vssm_gym.envs.robots.car_noise import TICK
from vssm_gym.envs.scenes.apartment import Apartment
from vssm_gym.geometry.axes import PlanarPose
from vssm_gym.geometry.car import Car

MOTOR_LAG = 0.005  # s, time constant of the motor where neither torque nor tyres limit it
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def build_car_spec(apartment: Apartment, car: Car) -> mujoco.MjSpec:
    """Build the model of a floor, the apartment's boxes as upright prisms and a free car; SI units, z up.

    Prisms are named after the index in ``apartment.boxes()``. The car's frame is the footprint's: on the floor below
    the rear axle.
    """
    spec = mujoco.MjSpec()
    spec.modelname = apartment.name
    option = spec.option
    option.timestep = DYNAMICS.substep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0  # tyres slip beyond their friction, and barely creep below it
    # Should a simulation ever burst, it stays so and the car counts as overturned, instead of starting at the origin.
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], contype=TYRES, conaffinity=TYRES
    )
    boxes = apartment.boxes()
    for i in obstacles(boxes, car.height):
        prism = fixed_box(spec, f"prism {i}", boxes[i], group=0, rgba=[0.7, 0.7, 0.7, 1.0])
        prism.pos[2], prism.size[2] = 0.5 * car.height, 0.5 * car.height + 1.0
        prism.contype, prism.conaffinity = BODY, BODY

    body = spec.worldbody.add_body(name="car")
    body.add_freejoint(name="car")
    tall = car.height - DYNAMICS.clearance
    body.add_geom(
        name="chassis",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[car.center_forward, 0.0, DYNAMICS.clearance + 0.5 * tall],
        size=[0.5 * car.length, 0.5 * car.width, 0.5 * tall],
        contype=BODY,
        conaffinity=BODY,
        priority=1,
        friction=[DYNAMICS.bumper_friction, 0.005, 0.0001],
        mass=0.0,
    )
    # Batteries and motors lie low: the box's mass is that of its lower third.
    body.add_geom(
        name="ballast",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0.5 * car.wheelbase, 0.0, DYNAMICS.clearance + tall / 6.0],
        size=[0.5 * car.length, 0.5 * car.width, tall / 6.0],
        contype=0,
        conaffinity=0,
        mass=DYNAMICS.chassis_mass,
    )
    for end, x in (("rear", 0.0), ("front", car.wheelbase)):
        for side, sign in (("left", 1.0), ("right", -1.0)):
            _add_wheel(spec, body, car, f"{end} {side}", (x, sign * 0.5 * car.track), steered=end == "front")
    _add_drive(spec, car)
    return spec


def _add_wheel(spec: mujoco.MjSpec, body: Any, car: Car, name: str, at: tuple[float, float], steered: bool) -> None:
    hub = body.add_body(name=name, pos=[*at, car.wheel_radius])
    if steered:
        hub.add_joint(name=f"{name} steering", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=1e-3)
        servo = spec.add_actuator(name=f"{name} steering", target=f"{name} steering")
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.set_to_position(kp=20.0, kv=0.2)  # settles within two substeps, and stiffer than contacts
    hub.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], armature=1e-5)
    hub.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=[car.wheel_radius, 0.01, car.wheel_radius],
        contype=TYRES,
        conaffinity=TYRES,
        priority=1,
        condim=3,
        solref=[2.0 * DYNAMICS.substep, 1.0],
        mass=DYNAMICS.wheel_mass,
    )


def _add_drive(spec: mujoco.MjSpec, car: Car) -> None:
    """Add one motor on the mean of the rear wheels: each gets half of its torque at every speed."""
    axle = spec.add_tendon(name="axle")
    for side in ("left", "right"):
        axle.wrap_joint(f"rear {side}", 0.5)
    motor = spec.add_actuator(name="motor", target="axle")
    motor.trntype = mujoco.mjtTrn.mjTRN_TENDON
    mass = DYNAMICS.mass
    motor.set_to_velocity(kv=mass * car.wheel_radius**2 / MOTOR_LAG)
    motor.forcelimited = True
    motor.forcerange = [
        -mass * DYNAMICS.max_acceleration * car.wheel_radius,
        mass * DYNAMICS.max_acceleration * car.wheel_radius,
    ]


class MujocoCar:
    """Simulate a :class:`~vssm_gym.envs.robots.car_body.CarBody` in MuJoCo.

    One object is one simulation, for one thread.
    """

    reads_contacts = True  # keep contacts for :meth:`contact_bearings`
    _bearings: list[np.ndarray]  # of obstacles hit in the last drive, rad, one array a substep

    def __init__(self, apartment: Apartment, car: Car) -> None:
        self.apartment, self.car = apartment, car
        self._build()

    def _build(self) -> None:
        self.boxes = self.apartment.boxes()
        self.model = build_car_spec(self.apartment, self.car).compile()
        self.data = mujoco.MjData(self.model)
        self._box_of_geom = boxes_of_geoms(self.model)
        self._body = self.model.body("car").id
        names = [f"{end} {side}" for end in ("rear", "front") for side in ("left", "right")]
        self._tyres = [self.model.geom(name).id for name in names]
        self.reset(np.zeros(3))

    def __getstate__(self) -> dict[str, Any]:
        state = np.empty(mujoco.mj_stateSize(self.model, _STATE))
        mujoco.mj_getState(self.model, self.data, state, _STATE)
        return {
            "apartment": self.apartment,
            "car": self.car,
            "state": state,
            "bearings": self._bearings,
            "reads_contacts": self.reads_contacts,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.apartment, self.car, self.reads_contacts = state["apartment"], state["car"], state["reads_contacts"]
        self._build()
        mujoco.mj_setState(self.model, self.data, state["state"], _STATE)
        self._bearings = state["bearings"]

    def reset(self, planar: PlanarPose) -> None:
        """Place the rear axle at ``(x, y, heading)``, m and rad, at rest."""
        mujoco.mj_resetData(self.model, self.data)
        self._bearings = []
        half = 0.5 * float(planar[2])
        self.data.qpos[:7] = planar[0], planar[1], 0.0, math.cos(half), 0.0, 0.0, math.sin(half)

    def drive(self, points: Float[np.ndarray, "ticks 2"], friction: float) -> tuple[str, ...]:
        """Follow ``(speed, steering)`` set points, one per TICK.

        Return the names of the obstacles hit, in the boxes' order.
        """
        model, data = self.model, self.data
        model.geom_friction[self._tyres, 0] = friction
        collided: set[int] = set()
        self._bearings = []
        for speed, steering in points.tolist():
            data.ctrl[:] = self._controls(speed, steering)
            for _ in range(round(TICK / DYNAMICS.substep)):
                mujoco.mj_step(model, data)
                if data.ncon:
                    boxes = self._box_of_geom[data.contact.geom]
                    met = boxes.max(axis=1).tolist()
                    collided.update(met)
                    if self.reads_contacts and max(met) >= 0:  # an obstacle, not the floor alone
                        which, R_world_body = np.array(met) >= 0, data.xmat[self._body]
                        self._bearings.append(bearings(boxes[which], data.contact.frame[which, :3], R_world_body))
        return tuple(dict.fromkeys(self.boxes[i].name for i in sorted(collided - {-1})))

    def contact_bearings(self) -> Float[np.ndarray, "n"]:
        """Return the directions of the obstacles in contact during the last :meth:`drive`, rad, from body x."""
        return np.concatenate(self._bearings) if self._bearings else np.zeros(0)

    def _controls(self, speed: float, steering: float) -> tuple[float, float, float]:
        """Return the set points of the two steering servos and the motor in the model's units."""
        return *ackermann(steering, self.car), speed / self.car.wheel_radius

    def pose(self) -> PlanarPose:
        """Return the rear axle's ``(x, y, heading)``, m and rad, heading in [-pi, pi); float64 ``(3,)``."""
        x, y, _, w, i, j, k = self.data.qpos[:7].tolist()
        heading = math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))
        return np.array([x, y, heading if heading < math.pi else -math.pi])

    def speed(self) -> float:
        """Return the speed of the rear axle along the heading, m/s."""
        heading = self.pose()[2]
        return float(math.cos(heading) * self.data.qvel[0] + math.sin(heading) * self.data.qvel[1])

    def upright(self) -> bool:
        """Return True if the car can drive: its tilt is below 45 degrees and it is on the floor."""
        _, _, z, _, i, j, _ = self.data.qpos[:7].tolist()
        return 1.0 - 2.0 * (i * i + j * j) > math.sqrt(0.5) and abs(z) < self.car.wheel_radius

    def close(self) -> None:
        """Do nothing: MuJoCo's memory is freed with the object."""
