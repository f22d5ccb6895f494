"""A noisy holonomic robot with an RGB-D camera in an apartment: what PointNav, ImageNav and Explore have in common.

An environment owns one :class:`Simulation`, tells it to :meth:`~Simulation.place` and :meth:`~Simulation.drive` the
robot, and adds goals, rewards and ends of its own. Moving and looking are apart: images are rendered when
:meth:`~Simulation.look` is called, so that a vector environment moves all robots first and then renders in parallel.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from vssm_gym.axes import Matrix4, PlanarPose
from vssm_gym.envs.eye import EXTENT, PICTURE, Eye
from vssm_gym.envs.lidar import Lidar, LidarConfig, LidarNoise, lidar_config, measured
from vssm_gym.envs.lidar import lidar_noise as lidar_noise_of
from vssm_gym.envs.mjcf import World
from vssm_gym.envs.robots import ExecutionNoise, HolonomicRobot, execute, execution_noise
from vssm_gym.envs.scene import load_scene
from vssm_gym.envs.scenery import scenery_of
from vssm_gym.envs.sensor_noise import SensorNoise
from vssm_gym.envs.sensor_noise import sensor_noise as sensor_noise_of
from vssm_gym.envs.sensors import RENDERERS, CameraConfig, camera_config
from vssm_gym.envs.stage import stage_of
from vssm_gym.envs.streams import STREAMS, seeded_streams
from vssm_gym.envs.topdown import TopDown, beside_plan
from vssm_gym.envs.validation import choose, parse_action
from vssm_gym.errors import InputError
from vssm_gym.geometry import planar_to_matrix

ROBOT_STREAMS = (*STREAMS, "lidar")


class Simulation:
    """One robot, its camera and its streams of random numbers; see the module.

    Args:
        scene: built-in name, ``procedural:SEED``, path of a scene file, or an :class:`Apartment`.
        noise: how motion strays from commands: ``none``, ``low``, ``mid``, ``high`` or an :class:`ExecutionNoise`.
        sensor_noise: what the camera adds to the exact image: ``none``, ``kinect``, ``stereo`` or a
            :class:`SensorNoise`.
        camera: size and angle of the images: a :class:`CameraConfig` or a mapping of its fields.
        renderer: ``raycast``, or ``gl`` where the machine has OpenGL. What made the images is in ``renderer_name``, to
            be recorded with results.
        physics: ``mujoco``.
        lidar: whether the robot has a laser scanner, and which: True, or a :class:`LidarConfig`, or a mapping of its
            fields; None and False for no scan.
        lidar_noise: how its ranges err: ``none``, ``hokuyo``, ``rplidar`` or a :class:`LidarNoise`.
        observe_pose: whether the observation holds the true pose (an oracle's privilege).
        render_mode: ``rgb_array`` or None.
    """

    def __init__(
        self,
        scene: Any = "oak",
        noise: str | ExecutionNoise = "low",
        sensor_noise: str | SensorNoise = "none",
        camera: CameraConfig | Mapping[str, Any] | None = None,
        renderer: str = "raycast",
        physics: str = "mujoco",
        lidar: bool | LidarConfig | Mapping[str, Any] | None = None,
        lidar_noise: str | LidarNoise = "none",
        observe_pose: bool = False,
        render_mode: str | None = None,
    ) -> None:
        choose("environment", "renderer", renderer, RENDERERS)
        choose("environment", "physics", physics, ("mujoco",))
        choose("environment", "render_mode", render_mode, (None, "rgb_array"))
        if not isinstance(observe_pose, bool):
            raise InputError("environment", "observe_pose", f"True or False; found {observe_pose!r:.80}")
        self.noise, self.sensor_noise = execution_noise(noise), sensor_noise_of(sensor_noise)
        self.observe_pose, self.render_mode = observe_pose, render_mode
        self.robot = HolonomicRobot()
        self.scenery = scenery_of(load_scene(scene), camera_config(camera), renderer)
        self.stage = stage_of(self.scenery, self.robot)
        self.apartment, self.camera = self.scenery.apartment, self.scenery.camera
        self.world = World(self.apartment, self.robot)
        self.streams: dict[str, np.random.Generator] = {}
        self.path_length = 0.0  # m driven since the robot was placed
        self.path: list[np.ndarray] = []  # its positions
        self._K, self._T_body_cam = self.camera.K, self.robot.T_body_cam
        self._eye = Eye(self.scenery, self.sensor_noise)
        config, self.lidar_noise = lidar_config(lidar), lidar_noise_of(lidar_noise)
        self._lidar = None if config is None else Lidar(config, self.scenery.tracer)
        self._scan: np.ndarray | None = None  # at the robot's pose
        # Whether several environments may look at once, in threads of one process
        self.parallel = self.scenery.parallel and (self._lidar is None or self.scenery.tracer.parallel)
        self._T_world_cam: Matrix4 | None = None  # at the robot's pose
        self._plan: TopDown | None = None

    def spaces(self) -> dict[str, gym.Space[Any]]:
        """The spaces of :meth:`observation`."""
        spaces = self._eye.spaces()
        if self._lidar is not None:
            config = self._lidar.config
            spaces["scan"] = gym.spaces.Box(0.0, config.max_range, (config.beams,), np.float32)
        if self.observe_pose:
            far = np.array([EXTENT, EXTENT, np.pi], np.float32)
            spaces["pose"] = gym.spaces.Box(-far, far)
        return spaces

    def action_space(self) -> gym.spaces.Box:
        """``(turn, o, s, stop)``: rad, rad, m, and above 0.5 for stop."""
        turn, offset, step = self.robot.limits
        low, high = [-turn, -offset, 0.0, 0.0], [turn, offset, step, 1.0]
        return gym.spaces.Box(np.array(low, np.float32), np.array(high, np.float32))

    @property
    def planar(self) -> PlanarPose:
        """The true ``(x, y, heading)``, m and rad; not for agents."""
        return self.world.pose()

    @property
    def T_world_cam(self) -> Matrix4:
        """The true camera pose; not for agents."""
        if self._T_world_cam is None:
            self._T_world_cam = planar_to_matrix(self.planar) @ self._T_body_cam
        return self._T_world_cam.copy()

    def seed(self, seed: int | None) -> None:
        """Restart all streams by a seed; without one they go on, or begin anywhere where there are none yet."""
        if seed is not None or not self.streams:
            self.streams = seeded_streams(seed, ROBOT_STREAMS)
            self._eye.seed(self.streams["sensors"])

    def place(self, start: PlanarPose) -> None:
        """Put the robot at ``(x, y, heading)``, m and rad: an episode begins."""
        self.world.reset(start)
        self.path_length, self.path = 0.0, [self.planar[:2]]
        self._moved()

    def drive(self, command: np.ndarray) -> bool:
        """Carry out ``(turn, o, s)`` for one step of ``robot.dt`` s, noise and contacts included.

        Returns whether the robot touched an obstacle.
        """
        before = self.planar
        collision = self.world.drive(execute(before, command, self.noise, self.streams["dynamics"]))
        after = self.planar[:2]
        self.path_length += float(np.hypot(*(after - before[:2])))
        self.path.append(after)
        self._moved()
        return collision

    def parse(self, action: Any) -> tuple[np.ndarray, bool]:
        """``(turn, o, s)`` clipped to the robot's limits, and whether ``stop`` is above 0.5.

        Raises :class:`InputError` for anything but four finite numbers.
        """
        values = parse_action(action, ("turn", "o", "s", "stop"))
        return self.robot.clip(values[:3]), bool(values[3] > 0.5)

    def look(self) -> None:
        """Take image and scan at the robot's pose, as its sensors measure them; once, however often it is asked for."""
        self._eye.look(self.T_world_cam, self.robot.dt)
        if self._lidar is not None and self._scan is None:
            exact = self._lidar.scan(planar_to_matrix(self.planar))
            self._scan = measured(exact, self.lidar_noise, self._lidar.config, self.streams["lidar"])

    def observation(self) -> dict[str, np.ndarray]:
        """``rgb``, ``depth`` and, where there are such, ``scan`` and ``pose``; the arrays are the caller's."""
        self.look()
        observation = self._eye.observation()
        if self._scan is not None:
            observation["scan"] = self._scan.copy()
        if self.observe_pose:
            observation["pose"] = self.planar.astype(np.float32)
        return observation

    def info(self, command: np.ndarray, collision: bool) -> dict[str, Any]:
        """What every environment reports beside the observation; agents never see it."""
        return {"T_world_cam": self.T_world_cam, "K": self._K.copy(), "collision": collision, "control": command}

    def picture(self, goal: np.ndarray | None = None, goal_radius: float = 0.0) -> np.ndarray | None:
        """The camera's image beside the plan with the path so far: uint8 ``(360, width, 3)``; None if not asked for."""
        if self.render_mode is None or not self.path:
            return None
        if self._plan is None:
            self._plan = TopDown(self.scenery.boxes, PICTURE, PICTURE)
        self.look()
        plan = self._plan.draw(np.array(self.path), self.planar, self.robot.radius, goal, goal_radius)
        return beside_plan(self._eye.rgb, plan)

    def _moved(self) -> None:
        self._eye.moved()
        self._T_world_cam = self._scan = None
