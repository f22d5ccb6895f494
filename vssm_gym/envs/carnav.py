"""Define CarNav: a 1:10 car with an RGB-D camera parks at poses, or drives to points, of a cluttered arena.

It acts ``(speed, steering, stop)``, in v0 without the stop, at 10 Hz and is simulated as rigid bodies, by MuJoCo or by
PyBullet, with servos that lag, a linkage with backlash and tyres that slip, none of which a planner's bicycle model
contains. The tables of observation, action, reward and termination are in ``docs/envs/carnav.md``.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
import shapely

from vssm_gym.envs.conventions.actions import Actions
from vssm_gym.envs.conventions.relative_goal import (
    GOAL_FORMS,
    GoalForm,
    is_reckoned,
    relative_goal,
    sensed_pose,
    with_relative_goal,
)
from vssm_gym.envs.phased import PhasedEnv, Report
from vssm_gym.envs.physics import MujocoCar
from vssm_gym.envs.rendering.captions import Caption, Panel
from vssm_gym.envs.rendering.car_picture import draw_run
from vssm_gym.envs.rendering.frames import Frames
from vssm_gym.envs.rendering.topdown import PICTURE, PLAN_GOAL, PLAN_PATH, PLAN_ROBOT, TopDown, at_height
from vssm_gym.envs.robots.car_body import PHYSICS, CarBody
from vssm_gym.envs.robots.car_noise import CarActuators, CarNoise, car_noise
from vssm_gym.envs.scenes.apartment_parts import MAX_COORDINATE
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.sensors import RENDERERS, CameraConfig, camera_config, rgbd_noise
from vssm_gym.envs.sensors.base import GroundBody, Sensor, SensorConfig
from vssm_gym.envs.sensors.pose import PoseSensor
from vssm_gym.envs.sensors.registry import parse_sensors
from vssm_gym.envs.sensors.rgbd import RGBDSensor, parse_images
from vssm_gym.envs.sensors.rgbd_noise import SensorNoise
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.envs.sensors.suite import SensorSuite
from vssm_gym.envs.sensors.task_observation import TaskObservation
from vssm_gym.envs.streams import STREAMS, seeded_streams
from vssm_gym.envs.tasks.car import TARGETS, CarTask, CarTaskSampler, Targets
from vssm_gym.envs.tasks.rewards import DenseReward
from vssm_gym.envs.validation import check_options, choose
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import Matrix4, PlanarPose
from vssm_gym.geometry.car import GOAL_RADIUS, Car
from vssm_gym.geometry.transforms import wrap_angle

# In metres gained, as those of PointNav.
CARNAV_REWARD = DenseReward(step_cost=0.005, success=2.5, collision_cost=0.05, alignment=0.1)
SUCCESSES = ("reached", "stopped at the target")  # reasons for which an episode ends with success
STANDING_SPEED = 0.05  # m/s, up to which a car that has stopped counts as standing: 5 mm a step


class CarNavEnv(PhasedEnv):
    """Simulate one car in one arena, truncated after 600 steps: 60 s.

    Registered as ``vssm_gym/CarNav-v1``, which ends at the agent's stop, and as ``vssm_gym/CarNav-v0``, which ends on
    arrival.

    Args:
        scene: built-in name, ``procedural:SEED``, path of a scene file, or an :class:`Apartment`.
        noise: execution noise: ``none``, ``low``, ``mid``, ``high`` or a :class:`CarNoise`.
        sensor_noise: errors of the camera: ``none``, ``kinect``, ``stereo`` or a :class:`SensorNoise`.
        camera: size and field of view of the images: a :class:`CameraConfig` or a mapping of its fields.
        renderer: ``raycast``, or ``gl`` where the machine has OpenGL.
        physics: ``mujoco``, or ``bullet`` where PyBullet is installed.
        targets: ``poses`` (x, y, heading) or ``points`` (x, y).
        end_on: ``stop``: the action has a third number, whose step brakes and ends the episode; success is evaluated at
            the end of that step and needs a car that stands. ``reach``: the episode ends on arrival, by the true pose
            (it rewards a lost car).
        control: the action's first number: ``speed``, m/s, or ``acceleration``, m/s^2.
        actions: ``metric`` (SI units) or ``normalized`` (in [-1, 1]).
        goal: ``map``: the goal in the map; ``sensed`` or ``true``: its distance and bearing from the pose that GPS and
            compass sense, or from the true pose (:mod:`vssm_gym.envs.conventions.relative_goal`).
        chain: if True, an episode begins where the one before has ended, speed and contact included.
        sensors: sensors besides the camera, as in PointNav: names, configurations or mappings.
        observe_pose: if True, the observation holds the true pose (an oracle's privilege).
        images: the images of the observation: some of ``rgb``, ``depth`` and ``depth_image``; True for the first two.
            Without any, nothing is rendered.
        reward: ``dense`` (metres gained along free space, costs of steps and collisions, a success reward) or
            ``sparse``.
        render_mode: ``rgb_array``, ``human`` (a window) or None.
        captions: if True, a strip of text lies below each picture; a window always shows it.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}  # noqa: RUF012  (Gymnasium's own declaration)

    def __init__(
        self,
        scene: Any = "arena",
        noise: str | CarNoise = "low",
        sensor_noise: str | SensorNoise = "none",
        camera: CameraConfig | Mapping[str, Any] | None = None,
        renderer: str = "raycast",
        physics: str = "mujoco",
        targets: Targets = "poses",
        end_on: Literal["stop", "reach"] = "reach",
        control: Literal["speed", "acceleration"] = "speed",
        actions: Literal["metric", "normalized"] = "metric",
        goal: GoalForm = "map",
        chain: bool = False,
        sensors: Sequence[str | SensorConfig | Mapping[str, Any]] = (),
        observe_pose: bool = False,
        images: bool | Sequence[str] = True,
        reward: Literal["dense", "sparse"] = "dense",
        render_mode: str | None = None,
        captions: bool = False,
    ) -> None:
        choose("CarNav", "renderer", renderer, RENDERERS)
        choose("CarNav", "physics", physics, PHYSICS)
        choose("CarNav", "targets", targets, TARGETS)
        choose("CarNav", "end_on", end_on, ("stop", "reach"))
        choose("CarNav", "control", control, ("speed", "acceleration"))
        choose("CarNav", "actions", actions, ("metric", "normalized"))
        choose("CarNav", "goal", goal, GOAL_FORMS)
        choose("CarNav", "reward", reward, ("dense", "sparse"))
        for field, value in (("chain", chain), ("observe_pose", observe_pose)):
            if not isinstance(value, bool):
                raise InputError("CarNav", field, f"True or False; found {value!r:.80}")
        self.noise, self.car, self.physics = car_noise(noise), Car(), physics
        shown = (("rgb", "depth") if images else ()) if isinstance(images, bool) else parse_images("CarNav", images)
        self.targets, self.control, self.chain, self.goal = targets, control, chain, goal
        self.end_on = end_on
        self.reward, self.frames, self.render_mode = reward, Frames("CarNav", render_mode, captions), render_mode
        self.apartment: Apartment = load_scene(scene)
        carried, seen = parse_sensors("CarNav", sensors), rgbd_noise.sensor_noise(sensor_noise)
        shared = SharedRenderer.of(self.apartment, camera_config(camera), renderer)
        self.camera, self._images = shared.camera, bool(shown)
        self._K = self.camera.K
        self.renderer_name = shared.name if shown else "none"
        camera_sensor = RGBDSensor(shared, seen, scaled="depth_image" in shown)
        mounted: list[Sensor[GroundBody]] = [camera_sensor] if shown else []
        mounted += [config.mount(shared) for config in carried]
        far = np.array([MAX_COORDINATE, MAX_COORDINATE, np.pi], np.float32)
        farthest = far if targets == "poses" else far[:2]
        oracle: list[Sensor[GroundBody]] = [PoseSensor()] if observe_pose else []
        told = TaskObservation("goal", gym.spaces.Box(-farthest, farthest), self._goal)
        self.sensors = SensorSuite("CarNav", [*mounted, told, *oracle])
        self.sensors.hide(*(key for key in camera_sensor.spaces if key not in shown))
        self.parallel = self.sensors.parallel
        self.sampler = CarTaskSampler.of(self.apartment, self.car)
        self.body = _make_body(physics, self.apartment, self.car)
        self.body.reads_contacts = self.sensors.reads_contacts
        self._goal_distance = self.sampler.goal_distance()
        self._actions = Actions(actions, (control, "steering"), self._bounds(), stop=end_on == "stop")
        self.action_space = self._actions.space
        observed = gym.spaces.Dict(self.sensors.spaces())
        if goal == "sensed" and is_reckoned(observed):
            expected = 'sensors=["gps_compass"] with "sensed": commands of a car on tyres cannot be reckoned with'
            raise InputError("CarNav", "goal", expected)
        self.observation_space = observed if goal == "map" else with_relative_goal(observed)

        self.task: CarTask | None = None
        self.path_length = 0.0  # m driven in this episode
        self.collisions = 0  # in this episode: contacts that the car has begun
        self.collided_with: tuple[str, ...] = ()  # names of the obstacles that it hit in the last step
        self._streams: dict[str, np.random.Generator] = {}
        self._actuators: CarActuators | None = None
        self._speed = 0.0  # m/s, as commanded
        self._planar: PlanarPose = np.zeros(3)
        self._body: GroundBody | None = None  # the car as it is, for the sensors
        self._path: list[np.ndarray] = []
        self._start: PlanarPose = np.zeros(3)
        self._to_goal = self._shortest = 0.0  # m along free space: now, and at the start
        self._potential = 0.0  # m, of the dense reward
        self._outcome: tuple[float, bool, dict[str, Any]] = (0.0, False, {})  # reward, terminated, info
        self._plan: TopDown | None = None

    @property
    def planar(self) -> PlanarPose:
        """Return the true ``(x, y, heading)`` of the rear axle, m and rad; not for agents."""
        return self._planar.copy()

    @property
    def T_world_cam(self) -> Matrix4:
        """Return the true camera pose; not for agents."""
        return self._carrier.T_world_cam.copy()

    @property
    def _carrier(self) -> GroundBody:
        """Return the true state of the car, for its sensors; not for agents."""
        if self._body is None:
            contacts = self.body.contact_bearings()
            self._body = GroundBody.at(self.planar, self.car.T_body_cam, self.car.dt, contacts)
        return self._body

    def begin(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Start a task: ``options["task"]``, or one of the seeded task stream.

        In a chain the car stays as it is and gets a new target, ``options["goal"]`` if that is given. It is placed
        again, at rest, without a chain, with a seed, with ``options["task"]``, with ``options["restart"]``, and after
        it overturned. A seed restarts all streams; without one they continue.

        Raises :class:`InputError` for a target that the car cannot reach, or a task of another scene.
        """
        options = check_options(options, "task", "goal", "restart")
        number = 0 if self.task is None else self.task.id + 1  # of a chain's next task
        task, goal, restart = options.get("task"), options.get("goal"), options.get("restart", False)
        if not isinstance(restart, bool):
            raise InputError("reset", "options['restart']", f"True or False; found {restart!r:.80}")
        on = self.chain and self.task is not None and seed is None and task is None and not restart
        on = on and self.body.upright() and self._on_floor()
        if goal is not None and not on:
            raise InputError("reset", "options['goal']", "a chain that continues; a 'task' sets where the car begins")
        if task is not None:
            self._check(task)
        elif goal is not None:
            task = self.sampler.task(self._planar.tolist(), self._parsed(goal), number)
        if seed is not None or not self._streams:
            self._streams = seeded_streams(seed, (*STREAMS, *self.sensors.streams))
            self.sensors.seed(self._streams)
        stream = self._streams["task"]
        if on:
            self.task = task or self.sampler.goal_from(stream, self._planar, self.targets, number)
        else:
            self.task = task or self.sampler.draw(stream, self.targets)
            self.body.reset(np.array(self.task.start))
            self._actuators = CarActuators(self.noise, self._streams["dynamics"])
            self._speed, self.collided_with = 0.0, ()
        self._planar = self.body.pose()
        self.path_length, self.collisions, self._path = 0.0, 0, [self._planar[:2]]
        self._body = None
        self.sensors.begin(self._carrier)
        self._start = self._planar.copy()
        self._goal_distance.aim(np.array(self.task.goal[:2]))
        self._to_goal = self._shortest = self._goal_distance(self._planar[:2])
        self._potential = self._cost_to_go(math.inf)
        info = self._info(np.zeros(2), False) | {"task": self.task, "start_pose": self._planar.copy()}
        self._outcome = 0.0, False, info

    def advance(self, action: np.ndarray) -> None:
        """Carry out ``(speed or acceleration, steering)`` for ``car.dt`` s, clipped to the limits; a stop brakes."""
        assert self.task is not None and self._actuators is not None  # step makes sure of it
        values, stop = self._actions.parse(action)
        before, was = self._speed, self._planar
        if stop:
            values[0] = 0.0 if self.control == "speed" else self._braking()
        if self.control == "acceleration":
            values[0] = before + values[0] * self.car.dt
        command = self.car.clip(values)
        self._speed = float(command[0])
        ramp = np.array([before if self.control == "acceleration" else self._speed, self._speed])
        points, friction = self._actuators(ramp, float(command[1]), self.car.dt)
        already, self.collided_with = bool(self.collided_with), self.body.drive(points, friction)
        self.collisions += bool(self.collided_with) and not already
        now = self.body.pose()
        self._planar = now if np.isfinite(now).all() else was
        self.path_length += float(np.hypot(*(self._planar[:2] - was[:2])))
        self._path.append(self._planar[:2])
        self._body = None
        self.sensors.moved()
        if self.control == "acceleration":
            command[0] = (self._speed - before) / self.car.dt
        lost = not (self.body.upright() and self._on_floor())
        reached = self.task.reached(self._planar)
        ended = "overturned or off the floor" if lost else self._stopped(reached) if stop else ""
        if self.end_on == "reach" and reached and not lost:
            ended = "reached"
        success = ended in SUCCESSES
        reward, info = self._reward(success), self._info(command, success)
        if ended:
            info["reason"] = ended
        self._outcome = reward, bool(ended), info

    def sense(self) -> None:
        """Let the sensors measure."""
        self.sensors.sense(self._carrier)

    def report(self) -> Report:
        """Return observation, reward, terminated, truncated (always False: a wrapper counts steps) and info."""
        assert self.task is not None
        self.sense()
        reward, terminated, info = self._outcome
        observation = self.sensors.observation()
        if self.goal != "map":
            sensed = self.goal == "sensed"
            pose = sensed_pose(observation, self._start, self._start) if sensed else self._planar
            observation = relative_goal(observation, pose)
        return observation, reward, terminated, False, info

    def panels(self) -> list[Panel]:
        """Return the camera's image, if there are images, and the plan, 360 pixels high."""
        assert self.task is not None
        if self._plan is None:
            self._plan = TopDown(self.apartment.boxes(), PICTURE, PICTURE)
        path, goal = np.array(self._path), np.array(self.task.goal)
        plan = draw_run(self._plan, path, self.car, self._planar, goal, GOAL_RADIUS)
        panels = [Panel(plan, "plan", {"path": PLAN_PATH, "car": PLAN_ROBOT, "target": PLAN_GOAL})]
        if self._images:
            self.sense()
            panels.insert(0, Panel(at_height(self.sensors.reading("rgb"), PICTURE), "camera"))
        return panels

    def captions(self) -> list[Caption]:
        """Return the straight distance to the target, and the turn that is left where the target has a heading."""
        assert self.task is not None
        goal = np.array(self.task.goal)
        captions = [Caption("target", f"{np.hypot(*(self._planar[:2] - goal[:2])):.2f} m")]
        if self.targets == "poses":
            captions.append(Caption("turn", f"{math.degrees(wrap_angle(goal[2] - self._planar[2])):+.0f}°"))
        return captions

    def close(self) -> None:
        """Free the simulator."""
        super().close()
        self.body.close()

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        speed, steering = self.car.limits
        high = np.array([speed if self.control == "speed" else self.car.max_acceleration, steering])
        return -high, high

    def _braking(self) -> float:
        """Return the acceleration that ends the commanded speed within a step, as far as the limit allows, m/s^2."""
        most = self.car.max_acceleration
        return float(np.clip(-self._speed / self.car.dt, -most, most))

    def _stopped(self, reached: bool) -> str:
        """Return how an episode has ended whose agent has just stopped."""
        if abs(self.body.speed()) > STANDING_SPEED:
            return "stopped while it rolled"
        return "stopped at the target" if reached else "stopped elsewhere"

    def _goal(self) -> np.ndarray:
        """Return the goal, as observed."""
        assert self.task is not None
        return np.array(self.task.goal, dtype=np.float32)

    def _info(self, control: np.ndarray, success: bool) -> dict[str, Any]:
        efficiency = 1.0 if self.path_length <= self._shortest else self._shortest / self.path_length
        return {
            "distance_to_goal": self._to_goal,
            "path_length": self.path_length,
            "success": success,
            "spl": efficiency if success else 0.0,
            "T_world_cam": self.T_world_cam,
            "K": self._K.copy(),
            "collision": bool(self.collided_with),
            "collisions": self.collisions,
            "control": control,
        }

    def _check(self, task: Any) -> None:
        if not isinstance(task, CarTask):
            raise InputError("reset", "options['task']", f"a CarTask; found {type(task).__name__}")
        self._parsed(task.goal)
        self.sampler.validate(task)

    def _parsed(self, goal: Any) -> list[float]:
        """Return a target of the kind that this environment has, checked."""
        names = ("x", "y", "heading")[: 3 if self.targets == "poses" else 2]
        try:
            values = np.asarray(goal, dtype=np.float64)
        except (TypeError, ValueError):
            values = np.zeros(0)
        if values.shape != (len(names),) or not np.isfinite(values).all():
            expected = (
                f"{len(names)} finite numbers ({', '.join(names)}): targets are {self.targets}; found {goal!r:.80}"
            )
            raise InputError("reset", "goal", expected)
        return values.tolist()

    def _on_floor(self) -> bool:
        return bool(shapely.intersects_xy(self.sampler.space.floor, *self._planar[:2]))

    def _cost_to_go(self, otherwise: float) -> float:
        """``d(x, y) + alignment |heading error|``, m, d along free space; ``otherwise`` where d is not known."""
        assert self.task is not None
        distance = self._goal_distance(self._planar[:2])
        if not np.isfinite(distance):
            return otherwise
        self._to_goal = distance
        return distance + CARNAV_REWARD.alignment * self.task.turn(self._planar)

    def _reward(self, success: bool) -> float:
        """Update the cost-to-go, and return the reward of this step."""
        prize = CARNAV_REWARD.success if success else 0.0
        # Pressed against an obstacle the axle may be off the grid of free positions: it gains nothing until it is back.
        now = self._cost_to_go(self._potential)
        gained = self._potential - now if np.isfinite(self._potential) else 0.0
        self._potential = now
        if self.reward == "sparse":
            return prize
        weights = CARNAV_REWARD
        return gained - weights.step_cost - weights.collision_cost * bool(self.collided_with) + prize


def _make_body(physics: str, apartment: Apartment, car: Car) -> CarBody:
    if physics == "bullet":
        from vssm_gym.envs.physics.bullet_car import BulletCar  # an extra

        return BulletCar(apartment, car)
    return MujocoCar(apartment, car)
