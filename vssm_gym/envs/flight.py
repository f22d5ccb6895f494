"""Define Flight: a multirotor with an RGB-D camera and an IMU follows a reference flight through a hall.

It commands specific force and body rates, is disturbed by gusts and drag, and must localise itself by images and IMU,
since the reference is given in the world's frame. The tables of observation, action, reward and termination are in
``docs/envs/flight.md``.
"""

from collections.abc import Mapping
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from vssm_gym.envs.flight_body import FlightBody, FlightNoise, FlightState, flight_noise, fly
from vssm_gym.envs.phased import PhasedEnv
from vssm_gym.envs.physics import FlightWorld
from vssm_gym.envs.rendering.captions import Caption, Panel
from vssm_gym.envs.rendering.frames import Frames
from vssm_gym.envs.rendering.topdown import (
    PICTURE,
    PLAN_GOAL,
    PLAN_PATH,
    PLAN_REFERENCE,
    PLAN_ROBOT,
    TopDown,
    at_height,
)
from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.scenes.free_space import FreeSpace
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.sensors import RENDERERS, CameraConfig, camera_config, imu, rgbd_noise
from vssm_gym.envs.sensors.base import Sensor
from vssm_gym.envs.sensors.flight import FlightPoseSensor, FlyingBody, ImuSensor
from vssm_gym.envs.sensors.imu import ImuSensorNoise
from vssm_gym.envs.sensors.rgbd import RGBDSensor
from vssm_gym.envs.sensors.rgbd_noise import SensorNoise
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.envs.sensors.suite import SensorSuite
from vssm_gym.envs.sensors.task_observation import TaskObservation
from vssm_gym.envs.streams import STREAMS, seeded_streams
from vssm_gym.envs.tasks.reference_flights import (
    CURVES,
    FLIGHT_HEIGHT,
    FLIGHT_LIFT,
    Placement,
    ReferenceFlight,
    Yaw,
    place,
)
from vssm_gym.envs.validation import check_options, choose, parse_action
from vssm_gym.errors import InputError
from vssm_gym.geometry.gravity import GRAVITY
from vssm_gym.geometry.transforms import matrix_to_planar

DRAWN_SPEEDS = (1.0, 4.0)  # m/s, between which a speed is drawn where none is given
SLOWEST, FASTEST = 0.2, 20.0  # m/s, range of the keyword; a flight that needs too much thrust is refused
LONGEST_FLIGHT = 600.0  # s, most of a reference, and so of an episode
STRAYED = 2.0  # m from the reference, at which the flight is given up
EARNING_DISTANCE = 1.0  # m from the reference, beyond which a step earns nothing
REFERENCE_POINTS = 512  # of the line that a picture shows
CRASH_COST = 5.0  # cost of a collision, in the dense reward
HOVERING = np.concatenate([-np.array(GRAVITY), np.zeros(3)])  # the command that hovers


class FlightEnv(PhasedEnv):
    """Simulate one body in one hall, with one reference flight per episode. Registered as ``vssm_gym/Flight-v0``.

    No wrapper counts its steps: an episode lasts as long as its reference, LONGEST_FLIGHT seconds at most, at any rate.

    Args:
        scene: built-in name, path of a scene file, or an :class:`Apartment`.
        noise: gusts and actuator errors: ``none``, ``low``, ``mid``, ``high`` or a :class:`FlightNoise`.
        sensor_noise: errors of the camera: a name of ``rgbd_noise.PRESETS`` or a :class:`SensorNoise`.
        imu_noise: errors of the IMU: a name of ``imu.PRESETS`` or an :class:`ImuSensorNoise`.
        camera: size and field of view of the images: a :class:`CameraConfig` or a mapping of its fields.
        rate: steps and images a second, 5 to 100. A step is ``substeps`` equal periods of the IMU, ``imu_period`` s
            each: the whole number that comes nearest to 5 ms.
        renderer: ``raycast``, or ``gl`` where the machine has OpenGL.
        observe_pose: if True, the observation holds true pose and velocity (an oracle's privilege).
        flight: name of the reference, or None: one is drawn at each reset.
        speed: its peak, m/s, 0.2 to 20 as far as the rotors allow, or None: drawn from DRAWN_SPEEDS.
        yaw: ``forward``: the nose points along the motion; ``constant``.
        reward: ``dense`` (nearness to the reference) or ``sparse`` (1 for a flight completed).
        render_mode: ``rgb_array``, ``human`` (a window) or None.
        captions: if True, a strip of text lies below each picture; a window always shows it.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        scene: Any = "hall",
        noise: str | FlightNoise = "low",
        sensor_noise: str | SensorNoise = "none",
        imu_noise: str | ImuSensorNoise = "adis16448",
        camera: CameraConfig | Mapping[str, Any] | None = None,
        rate: float = 20.0,
        renderer: str = "raycast",
        observe_pose: bool = False,
        flight: str | None = None,
        speed: float | None = None,
        yaw: Yaw = "forward",
        reward: Literal["dense", "sparse"] = "dense",
        render_mode: str | None = None,
        captions: bool = False,
    ) -> None:
        choose("Flight", "renderer", renderer, RENDERERS)
        choose("Flight", "flight", flight, (None, *CURVES))
        choose("Flight", "yaw", yaw, ("forward", "constant"))
        choose("Flight", "reward", reward, ("dense", "sparse"))
        if speed is not None and not (_number(speed) and SLOWEST <= speed <= FASTEST):
            raise InputError("Flight", "speed", f"{SLOWEST:g} to {FASTEST:g} m/s, or None; found {speed!r:.80}")
        if not (_number(rate) and 5.0 <= rate <= 100.0):
            raise InputError("Flight", "rate", f"steps a second between 5 and 100, not {rate!r:.80}")
        self.noise, inertial, seen = (
            flight_noise(noise),
            imu.imu_noise(imu_noise),
            rgbd_noise.sensor_noise(sensor_noise),
        )
        self.reward, self.frames, self.render_mode = reward, Frames("Flight", render_mode, captions), render_mode
        self.flight, self.speed, self.yaw = flight, speed, yaw
        self.apartment: Apartment = load_scene(scene)
        self.body, self.dt = FlightBody(), 1.0 / rate
        self.metadata = {**self.metadata, "render_fps": round(rate)}
        self.substeps = max(1, round(self.dt / self.body.substep))
        self.imu_period = self.dt / self.substeps  # s
        self._places: dict[str, Placement] = {}
        if flight is not None:
            self._checked(self._reference(flight, DRAWN_SPEEDS[0] if speed is None else speed))
        self.world = FlightWorld(self.apartment, self.body.radius)
        self.renderer = SharedRenderer.of(self.apartment, camera_config(camera), renderer)
        self.camera, self.renderer_name = self.renderer.camera, self.renderer.name
        self._K = self.camera.K

        low, high = self.body.limits
        self.action_space = gym.spaces.Box(low.astype(np.float32), high.astype(np.float32))
        wanted = gym.spaces.Box(-MAX_COORDINATE, MAX_COORDINATE, (10,), np.float32)
        reference = TaskObservation("reference", wanted, self._wanted)
        oracle: list[Sensor[FlyingBody]] = [FlightPoseSensor()] if observe_pose else []
        sensors: list[Sensor[FlyingBody]] = [
            RGBDSensor(self.renderer, seen),
            ImuSensor(inertial, self.substeps),
            reference,
            *oracle,
        ]
        self.sensors = SensorSuite("Flight", sensors)
        self.parallel = self.sensors.parallel
        self.observation_space = gym.spaces.Dict(self.sensors.spaces())

        self._streams: dict[str, np.random.Generator] = {}
        self.task: ReferenceFlight | None = None
        self.steps = 0  # of this episode
        self._plan: TopDown | None = None

    @property
    def time(self) -> float:
        """Return the seconds since the reset."""
        return self.steps * self.dt

    def begin(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Hover at the start of ``options["task"]``, a :class:`ReferenceFlight`, or of one from the task stream.

        A seed restarts all streams; without one they continue. Raises :class:`InputError` for a flight that the body
        cannot fly here.
        """
        task = check_options(options, "task").get("task")
        if task is not None and not isinstance(task, ReferenceFlight):
            raise InputError("reset", "options['task']", f"a ReferenceFlight; found {type(task).__name__}")
        if seed is not None or not self._streams:
            self._streams = seeded_streams(seed, (*STREAMS, *self.sensors.streams))
            self.sensors.seed(self._streams)
        self.task = self._checked(self._drawn() if task is None else task)
        motion = self.task.at(np.zeros(1))
        self.state = FlightState(motion.position[0], motion.velocity[0], motion.R_world_body[0])
        self.world.reset(self.state.position)
        self.steps, self._collision, self._first = 0, False, True
        self._control, self._gust = HOVERING.copy(), np.zeros(6)
        self._felt = np.tile(HOVERING, (self.substeps, 1))
        self._path = [self.state.position]
        self.sensors.begin(self._carrier())

    def advance(self, action: np.ndarray) -> None:
        """Carry out ``(specific force, body rates)`` for one period, clipped to the limits."""
        assert self.task is not None
        self._control = self._command(action)
        self._gust = self.noise.following(self._gust, self.dt, self._streams["dynamics"])
        h, self._felt, self._collision = self.imu_period, np.empty((self.substeps, 6)), False
        for k in range(self.substeps):
            after, self._felt[k] = fly(self.state, self._control, self._gust, self.body.drag, h)
            if self.world.move((after.position - self.state.position) / h, h):
                self._collision = True
                after = FlightState(self.world.position(), self.world.velocity(), after.R_world_body)
            self.state = after
        self.steps, self._first = self.steps + 1, False
        self.sensors.moved()
        self._path.append(self.state.position)

    def sense(self) -> None:
        """Let the sensors measure, once a step however often it is called; it changes no other state."""
        self.sensors.sense(self._carrier())

    def report(self) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info of the present state."""
        assert self.task is not None
        error = self.tracking_error()
        strayed, arrived = error > STRAYED, self.time >= self.task.duration
        terminated = self._collision or strayed or arrived
        success = arrived and not self._collision and not strayed
        info: dict[str, Any] = {
            "T_world_cam": self._carrier().T_world_cam,
            "K": self._K.copy(),
            "collision": self._collision,
            "control": self._control.copy(),
            "tracking_error": error,
        }
        if self._first:
            info |= {"task": self.task, "start_pose": self.state.T_world_body}
        if terminated:
            info["success"] = success
        if self._first or self.reward == "sparse":
            reward = float(success)
        else:
            reward = self.dt * max(0.0, 1.0 - error / EARNING_DISTANCE) - CRASH_COST * self._collision
        return self.sensors.observation(), reward, terminated, False, info

    def panels(self) -> list[Panel]:
        """Return the camera's image and the plan with the reference and the path so far, 360 pixels high."""
        assert self.task is not None
        if self._plan is None:
            self._plan = TopDown(self.world.boxes, PICTURE, PICTURE)
        self.sense()
        planar = matrix_to_planar(self.state.T_world_body)
        goal = self.task.at(np.array([self.time])).position[0, :2]
        ahead = self.task.at(np.linspace(0.0, self.task.duration, REFERENCE_POINTS)).position[:, :2]
        path, reach = np.array(self._path)[:, :2], 0.5 * EARNING_DISTANCE
        plan = self._plan.draw(path, planar, self.body.radius, goal, reach, ahead)
        legend = {"reference": PLAN_REFERENCE, "reference now": PLAN_GOAL, "path": PLAN_PATH, "body": PLAN_ROBOT}
        return [Panel(at_height(self.sensors.reading("rgb"), PICTURE), "camera"), Panel(plan, "plan", legend)]

    def captions(self) -> list[Caption]:
        """Return time, height and the distance to the present position of the reference."""
        return [
            Caption("time", f"{self.time:.2f} s"),
            Caption("height", f"{self.state.position[2]:.2f} m"),
            Caption("error", f"{self.tracking_error():.2f} m"),
        ]

    def tracking_error(self) -> float:
        """Return the distance to the present position of the reference, m."""
        assert self.task is not None
        return float(np.linalg.norm(self.state.position - self.task.at(np.array([self.time])).position[0]))

    def _carrier(self) -> FlyingBody:
        """Return the true state of the body, for its sensors; not for agents."""
        T_world_body, T_body_cam = self.state.T_world_body, self.body.T_body_cam
        return FlyingBody(T_world_body, self.state.velocity, T_body_cam, self.dt, self._felt, self.imu_period)

    def _reference(self, name: str, speed: float) -> ReferenceFlight:
        if name not in self._places:
            self._places[name] = place(self.apartment, name)
        return ReferenceFlight(name, speed, self._places[name], self.yaw, drag=self.body.drag)

    def _drawn(self) -> ReferenceFlight:
        """Draw the next task; both numbers are drawn even if they are not needed."""
        stream = self._streams["task"]
        name, speed = list(CURVES)[stream.integers(len(CURVES))], float(stream.uniform(*DRAWN_SPEEDS))
        return self._reference(self.flight or name, speed if self.speed is None else self.speed)

    def _checked(self, reference: ReferenceFlight) -> ReferenceFlight:
        """Return the flight if its path is free, the body is strong enough and it ends in time.

        Else raise InputError.
        """
        if reference.duration > LONGEST_FLIGHT:
            expected = (
                f"a flight of at most {LONGEST_FLIGHT:g} s; {reference.speed:g} m/s here takes {reference.duration:.0f}"
            )
            raise InputError("Flight", "speed", expected)
        limit = 0.8 * self.body.limits[1][2]
        if not (needed := reference.push()) <= limit:
            expected = f"a flight that asks for at most {limit:.1f} m/s^2 of the rotors, so that some is left to steer"
            raise InputError("Flight", "speed", f"{expected}; {reference.speed:g} m/s here asks for {needed:.1f}")
        if self._places.get(reference.name) != reference.place:
            space = FreeSpace.from_apartment(
                self.apartment, self.body.radius, FLIGHT_HEIGHT + FLIGHT_LIFT + self.body.radius
            )
            path = reference.at(np.linspace(0.0, reference.duration, 2048)).position[:, :2]
            if not (free := space.contains(path)).all():
                obstacles = ", ".join(space.obstacles_at(path[~free][0])[:3]) or "the end of the floor"
                raise InputError("reset", "options['task']", f"a path free of obstacles; it meets {obstacles}")
        return reference

    def _command(self, action: np.ndarray) -> Float[np.ndarray, "6"]:
        values = parse_action(action, ("fx", "fy", "fz", "wx", "wy", "wz"))
        return np.clip(values, *self.body.limits)

    def _wanted(self) -> Float[np.ndarray, "10"]:
        """Return the reference at the end of the coming step: position, velocity, acceleration, heading.

        World frame.
        """
        assert self.task is not None
        motion = self.task.at(np.array([self.time + self.dt]))
        nose = motion.R_world_body[0, :, 0]
        wanted = [motion.position[0], motion.velocity[0], motion.acceleration[0], [np.arctan2(nose[1], nose[0])]]
        return np.concatenate(wanted).astype(np.float32)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
