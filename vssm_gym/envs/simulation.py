"""Simulate a noisy robot with an RGB-D camera in an apartment: the common part of PointNav, ImageNav and Explore.

An environment owns one :class:`Simulation`, calls :meth:`~Simulation.place` and :meth:`~Simulation.drive`, and adds
goals, rewards and terminations of its own. Moving and sensing are separate: images are rendered when
:meth:`~Simulation.sense` is called, so that a vector environment moves all robots first and then renders in parallel.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from vssm_gym.envs.conventions.actions import ACTION_FORMS, ActionForm, Actions
from vssm_gym.envs.conventions.randomization import STREAM as RANDOMIZATION
from vssm_gym.envs.conventions.randomization import (
    Randomization,
    between_noises,
    light_table,
    parse_randomization,
)
from vssm_gym.envs.physics import FloorWorld
from vssm_gym.envs.rendering.captions import Panel
from vssm_gym.envs.rendering.frames import Frames
from vssm_gym.envs.rendering.topdown import PICTURE, PLAN_LEGEND, TopDown, at_height
from vssm_gym.envs.robots import DIRECTION_FRAMES, ExecutionNoise, HolonomicRobot
from vssm_gym.envs.robots.base import Robot, camera_ahead
from vssm_gym.envs.robots.registry import ROBOTS
from vssm_gym.envs.scenes.scene import Apartment, load_scene
from vssm_gym.envs.sensors import RENDERERS, CameraConfig, camera_config, rgbd_noise
from vssm_gym.envs.sensors.base import NO_CONTACTS, GroundBody, Sensor, SensorConfig
from vssm_gym.envs.sensors.pose import PoseSensor
from vssm_gym.envs.sensors.registry import parse_sensors
from vssm_gym.envs.sensors.rgbd import RGBDSensor, parse_images
from vssm_gym.envs.sensors.rgbd_noise import SensorNoise
from vssm_gym.envs.sensors.shared_renderer import SharedRenderer
from vssm_gym.envs.sensors.suite import SensorSuite
from vssm_gym.envs.streams import STREAMS, seeded_streams
from vssm_gym.envs.tasks.scene_cache import SceneCache
from vssm_gym.envs.validation import choose
from vssm_gym.errors import InputError
from vssm_gym.geometry.axes import DirectionFrame, Matrix4, PlanarPose
from vssm_gym.geometry.transforms import planar_to_matrix


class Stage(NamedTuple):
    """Hold what a simulation needs of one scene."""

    renderer: SharedRenderer
    scene_cache: SceneCache
    world: FloorWorld
    mounted: list[Sensor[GroundBody]]  # sensors besides the camera


class Simulation:
    """Simulate one robot with its sensors and its streams of random numbers.

    Args:
        scene: built-in name, ``procedural:SEED``, path of a scene file, or an :class:`Apartment`.
        robot: a name of :data:`~vssm_gym.envs.robots.registry.ROBOTS`.
        direction_frame: of the holonomic robot's ``o``: ``body``, the direction of travel relative to the heading, or
            ``world``, an absolute direction, which gives the robot a free compass.
        noise: execution noise: ``none``, ``low``, ``mid``, ``high`` or the robot's noise: an :class:`ExecutionNoise` of
            the holonomic one, which also has ``locobot``.
        sensor_noise: errors of the camera: ``none``, ``kinect``, ``stereo`` or a :class:`SensorNoise`.
        camera: size and field of view of the images: a :class:`CameraConfig` or a mapping of its fields.
        renderer: ``raycast``, or ``gl`` where the machine has OpenGL. The environment's ``renderer_name`` is recorded
            with results.
        physics: ``mujoco``.
        sensors: sensors besides the camera: names of :data:`~vssm_gym.envs.sensors.registry.SENSORS`, configurations,
            or mappings of their fields with ``"sensor": name``.
        observe_pose: if True, the observation holds the true pose (an oracle's privilege).
        images: the images of the observation: some of ``rgb``, ``depth`` and ``depth_image``.
        randomize: what varies between episodes: a :class:`Randomization` or a mapping of its fields.
        actions: ``metric`` (SI units), ``normalized`` (in [-1, 1]) or ``discrete`` (forward, left, right); see
            :mod:`vssm_gym.envs.conventions.actions`.
        render_mode: ``rgb_array``, ``human`` (a window) or None.
        captions: if True, a strip of text lies below each picture; a window always shows it.
    """

    def __init__(
        self,
        scene: Any = "oak",
        robot: str = "holonomic",
        direction_frame: DirectionFrame = "body",
        noise: str | ExecutionNoise | Any = "low",
        sensor_noise: str | SensorNoise = "none",
        camera: CameraConfig | Mapping[str, Any] | None = None,
        renderer: str = "raycast",
        physics: str = "mujoco",
        sensors: Sequence[str | SensorConfig | Mapping[str, Any]] = (),
        observe_pose: bool = False,
        images: Sequence[str] = ("rgb", "depth"),
        actions: ActionForm = "metric",
        randomize: Randomization | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        captions: bool = False,
    ) -> None:
        choose("environment", "robot", robot, tuple(ROBOTS))
        choose("environment", "renderer", renderer, RENDERERS)
        choose("environment", "physics", physics, ("mujoco",))
        choose("environment", "actions", actions, ACTION_FORMS)
        shown = parse_images("environment", images)
        if not isinstance(observe_pose, bool):
            raise InputError("environment", "observe_pose", f"True or False; found {observe_pose!r:.80}")
        self.robot = _in_frame(ROBOTS[robot](), direction_frame, actions)
        self.frames = Frames("environment", render_mode, captions)
        self.noise = self.robot.parse_noise(noise)
        self._carried, seen = parse_sensors("environment", sensors), rgbd_noise.sensor_noise(sensor_noise)
        self._random = parse_randomization(randomize)
        self._noises = self._random.noises(self.robot.parse_noise)
        self._check_random(renderer)
        apartments = [load_scene(one) for one in self._random.scene or (scene,)]
        self._config, self._backend = camera_config(camera), renderer
        self._stages: list[Apartment | Stage] = list(apartments)  # built at the first episode that needs them
        stage = self._stage(0)
        self.renderer, self.scene_cache, self.world, self._mounted = stage
        self.apartment, self.camera, self.hfov = self.renderer.apartment, self.renderer.camera, self._config.hfov
        oracle = [PoseSensor()] if observe_pose else []
        self._rgbd = RGBDSensor(self.renderer, seen, scaled="depth_image" in shown)
        self.sensors = SensorSuite("environment", [self._rgbd, *self._mounted, *oracle])
        self.sensors.hide(*(key for key in self._rgbd.spaces if key not in shown))
        self.world.reads_contacts = self.sensors.reads_contacts
        self.streams: dict[str, np.random.Generator] = {}
        self.path_length = 0.0  # m driven since the robot was placed
        self.path: list[np.ndarray] = []  # its positions
        self._reached = self.rest  # what the drive has reached of the commands
        self._K, self._T_body_cam = self.camera.K, self.robot.T_body_cam
        self._form, self._actions = actions, self._actions_of(actions, stops=True)
        self._body: GroundBody | None = None  # the robot as it is, for the sensors
        self._plan: TopDown | None = None

    @property
    def scenes(self) -> int:
        """Return the number of scenes that episodes are drawn from."""
        return len(self._stages)

    @property
    def parallel(self) -> bool:
        """Return True if several environments may sense at once, in threads of one process."""
        return self.sensors.parallel

    def action_space(self, stops: bool = True) -> gym.spaces.Space[Any]:
        """Return the space of the robot's commands, such as ``(turn, o, s)``, and of ``stop``.

        Where ``stops`` is False, only metric actions have a ``stop``, which then means nothing.
        """
        self._actions = self._actions_of(self._form, stops)
        return self._actions.space

    def _actions_of(self, form: ActionForm, stops: bool) -> Actions:
        robot = self.robot
        return Actions(form, robot.commands, robot.bounds, robot.moves, stop=stops or form == "metric")

    @property
    def rest(self) -> np.ndarray:
        """Return the command without motion."""
        return np.zeros(len(self.robot.commands))

    @property
    def planar(self) -> PlanarPose:
        """Return the true ``(x, y, heading)``, m and rad; not for agents."""
        return self.world.pose()

    @property
    def body(self) -> GroundBody:
        """Return the true state of the robot, for its sensors; not for agents."""
        if self._body is None:
            contacts = self.world.contact_bearings() if self.world.reads_contacts else NO_CONTACTS
            self._body = GroundBody.at(self.planar, self._T_body_cam, self.robot.dt, contacts)
        return self._body

    @property
    def T_world_cam(self) -> Matrix4:
        """Return the true camera pose; not for agents."""
        return self.body.T_world_cam.copy()

    def seed(self, seed: int | None) -> None:
        """Restart all streams by a seed; without one they continue, or start from fresh entropy the first time."""
        if seed is not None or not self.streams:
            self.streams = seeded_streams(seed, (*STREAMS, *self.sensors.streams, RANDOMIZATION))
            self.sensors.seed(self.streams)

    def varies(self, field: str) -> bool:
        """Return True if a field of :class:`Randomization` varies from episode to episode."""
        return bool(getattr(self._random, field))

    def vary(self) -> bool:
        """Draw scene, noise and camera of the next episode; return False where nothing varies."""
        if self._random == Randomization():
            return False
        drawn = self._random.draw(self.streams[RANDOMIZATION])
        if drawn.scene is not None:
            self._enter(drawn.scene)
        if drawn.noise is not None and self._noises is not None:
            self.noise = between_noises(*self._noises, drawn.noise)
        if drawn.camera_height is not None:
            self._T_body_cam = camera_ahead(drawn.camera_height)
        self._rgbd.look(self.renderer, drawn.hfov, None if drawn.light is None else light_table(drawn.light))
        self.camera, self._K = self._rgbd.camera, self._rgbd.camera.K
        self.hfov = self._config.hfov if drawn.hfov is None else drawn.hfov
        return True

    def view_from(self, planar: PlanarPose) -> tuple[np.ndarray, np.ndarray]:
        """Return the exact image that the robot's camera would take at ``(x, y, heading)``: colour, and depth in m."""
        return self._rgbd.render(planar_to_matrix(planar) @ self._T_body_cam)

    def _stage(self, number: int) -> "Stage":
        """Return what the simulation needs of a scene, which is built once."""
        one = self._stages[number]
        if not isinstance(one, Stage):
            shared = SharedRenderer.of(one, self._config, self._backend)
            mounted: list[Sensor[GroundBody]] = [config.mount(shared) for config in self._carried]
            one = Stage(shared, SceneCache.of(shared, self.robot), FloorWorld(one, self.robot), mounted)
            self._stages[number] = one
        return one

    def _enter(self, number: int) -> None:
        """Continue in another scene: streams and noise stay, sensors are mounted there."""
        stage = self._stage(number)
        if stage.world is self.world:
            return
        self.sensors.exchange(self._mounted, stage.mounted)
        stage.world.reads_contacts = self.world.reads_contacts
        self.renderer, self.scene_cache, self.world, self._mounted = stage
        self.apartment, self._plan = self.renderer.apartment, None
        for sensor in self._mounted:
            sensor.seed(self.streams[sensor.stream])

    def _check_random(self, renderer: str) -> None:
        """Raise :class:`InputError` for a range that the robot or the renderer cannot have."""
        height, random = self.robot.height, self._random
        if random.camera_height is not None and random.camera_height[1] > height:
            expected = f"heights within the robot, up to {height} m; found {list(random.camera_height)}"
            raise InputError("randomize", "camera_height", expected)
        if random.hfov is not None and renderer != "raycast":
            raise InputError("randomize", "hfov", f"renderer='raycast'; {renderer!r} has one field of view")

    def place(self, start: PlanarPose) -> None:
        """Start an episode with the robot at ``(x, y, heading)``, m and rad."""
        self.world.reset(start)
        self.path_length, self.path = 0.0, [self.planar[:2]]
        self._reached = self.rest
        self._body = None
        self.sensors.begin(self.body)

    def drive(self, command: np.ndarray) -> bool:
        """Carry out a command for one step of ``robot.dt`` s, noise and contacts included; return True on collision."""
        before = self.planar
        self._reached, carried_out = self.robot.respond(self._reached, command)
        collision = self.world.drive(self.robot.execute(before, carried_out, self.noise, self.streams["dynamics"]))
        after = self.planar[:2]
        self.path_length += float(np.hypot(*(after - before[:2])))
        self.path.append(after)
        self._body = None
        self.sensors.moved()
        return collision

    def parse(self, action: Any) -> tuple[np.ndarray, bool]:
        """Return the command within the robot's limits, and True if the action is a stop.

        Raises :class:`InputError` for anything but an action of the space, apart from its bounds.
        """
        return self._actions.parse(action)

    def sense(self) -> None:
        """Let the sensors measure, once after every motion however often it is called."""
        self.sensors.sense(self.body)

    def observation(self) -> dict[str, np.ndarray]:
        """Return copies of the sensors' latest measurements."""
        self.sense()
        return self.sensors.observation()

    def info(self, command: np.ndarray, collision: bool) -> dict[str, Any]:
        """Return the entries of ``info`` that all environments share; agents never see them."""
        return {"T_world_cam": self.T_world_cam, "K": self._K.copy(), "collision": collision, "control": command}

    def panels(self, goal: np.ndarray | None = None, goal_radius: float = 0.0) -> list[Panel]:
        """Return the camera's image and the plan with the path so far, 360 pixels high."""
        if self._plan is None:
            self._plan = TopDown(self.renderer.boxes, PICTURE, PICTURE)
        self.sense()
        plan = self._plan.draw(np.array(self.path), self.planar, self.robot.radius, goal, goal_radius)
        legend = {name: colour for name, colour in PLAN_LEGEND.items() if name != "goal" or goal is not None}
        return [Panel(at_height(self.sensors.reading("rgb"), PICTURE), "camera"), Panel(plan, "plan", legend)]


def _in_frame(robot: Robot, frame: DirectionFrame, actions: ActionForm) -> Robot:
    """Return the robot with its directions in ``frame``; raise :class:`InputError` where it has none there."""
    choose("environment", "direction_frame", frame, DIRECTION_FRAMES)
    if frame == "body":
        return robot
    if not isinstance(robot, HolonomicRobot):
        raise InputError("environment", "direction_frame", "'body': only the holonomic robot drives in any direction")
    if actions == "discrete":
        raise InputError("environment", "direction_frame", "'body' with discrete actions: forward is along the heading")
    return replace(robot, direction_frame=frame)
