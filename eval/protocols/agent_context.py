"""Build the context that an agent receives before an episode; it contains no scene."""

from dataclasses import asdict
from functools import singledispatch
from typing import Any, Protocol, TypeAlias

import gymnasium as gym
import numpy as np

from vssm_gym.agents.base import AgentContext
from vssm_gym.envs.robots import BiasedExecutionNoise, ExecutionNoise
from vssm_gym.envs.robots.car_noise import CarNoise
from vssm_gym.envs.robots.differential import DifferentialExecutionNoise, DifferentialRobot
from vssm_gym.eval.protocols.car_model_error import car_model_error
from vssm_gym.geometry.car import GOAL_RADIUS, Car
from vssm_gym.inference.scan_encoder.network import ScanEncoder
from vssm_gym.maps.voxel_map import VoxelMap
from vssm_gym.model.scan_model import ScanModel
from vssm_gym.model.transition import BiasedNoise, Bicycle, MotionNoise, Planar, Transition
from vssm_gym.model.transition.differential import DifferentialDrive, DifferentialNoise

KnownNoise: TypeAlias = ExecutionNoise | BiasedExecutionNoise | DifferentialExecutionNoise | CarNoise
"""The execution noise of a robot, as its environment has it and as its agent assumes it."""
SCANNER_COMMANDS = (0, 2)  # of the robot's limits: with a laser scanner it turns and drives, and never sideways


class RobotBody(Protocol):
    """Define what a context reads of a robot."""

    @property
    def T_body_cam(self) -> np.ndarray:
        """``(4, 4)`` pose of the camera in the body frame, m."""
        ...

    @property
    def limits(self) -> np.ndarray:
        """Return the largest components of a command."""
        ...

    @property
    def dt(self) -> float:
        """Return the duration of a step, s."""
        ...


@singledispatch
def transition_of(body: Any, noise: Any) -> Transition:
    """Return the transition model of a robot: :class:`Planar`, unless its type is registered here.

    Args:
        body: the robot.
        noise: its execution noise, a :data:`KnownNoise`.
    """
    biased = isinstance(noise, BiasedExecutionNoise)
    model = BiasedNoise(**asdict(noise)) if biased else MotionNoise(noise.turn, noise.step)
    return Planar(model, direction_frame=body.direction_frame)


transition_of.register(Car, lambda body, noise: Bicycle(car_model_error(noise), body.wheelbase))
transition_of.register(
    DifferentialRobot, lambda body, noise: DifferentialDrive(DifferentialNoise(noise.slip, noise.play), body.track)
)


def _deviations(body: Any, noise: KnownNoise) -> tuple[float, float]:
    """Return how far a step strays, (direction rad, distance m), for agents that keep clear of it; see AgentContext."""
    if isinstance(noise, DifferentialExecutionNoise | CarNoise):
        return 0.0, 0.0
    return noise.deviations(body.max_step) if isinstance(noise, BiasedExecutionNoise) else (noise.turn, noise.step)


def context_of(
    body: RobotBody,
    length: float,
    start_pose: np.ndarray,
    *,
    success_radius: float,
    noise: KnownNoise,
    voxel_map: VoxelMap | None = None,
    camera: Any = None,
    K: np.ndarray | None = None,
    limits: np.ndarray | None = None,
    stops: bool = False,
    scan_model: ScanModel | None = None,
    scan_encoder: ScanEncoder | None = None,
) -> AgentContext:
    """Build the context of a robot.

    Args:
        body: its geometry; a :class:`Car` is passed to the agent as a whole.
        length: diameter of the robot's footprint, or length of the car's, m.
        start_pose: ``(3,)`` x, y (m), heading (rad).
        success_radius: around the goal, m; 0 without a goal.
        noise: the execution noise that the agent assumes.
        voxel_map: the learned map, None for an agent that needs none.
        camera: an object with ``width`` and ``height`` in pixels; None without one.
        K: ``(3, 3)`` of the camera, pixels; None without one.
        limits: largest commands, where they are not all of the body's limits.
        stops: of a car, True where the episode ends on its stop.
        scan_model: the learned model of scans, None for an agent that needs none.
        scan_encoder: of that model, None for an agent whose goals are no scans.
    """
    return AgentContext(
        K=np.eye(3) if K is None else np.array(K),
        camera=(0, 0) if camera is None else (camera.width, camera.height),
        T_body_cam=body.T_body_cam,
        limits=body.limits if limits is None else limits,
        dt=body.dt,
        map=voxel_map,
        start_pose=np.array(start_pose),
        body_length=length,
        success_radius=success_radius,
        noise=_deviations(body, noise),
        transition=transition_of(body, noise),
        car=body if isinstance(body, Car) else None,
        direction_frame=getattr(body, "direction_frame", "body"),  # the holonomic robot has it
        stops=stops,
        scan_model=scan_model,
        scan_encoder=scan_encoder,
    )


def agent_context(env: gym.Env, info: dict[str, Any], voxel_map: VoxelMap | None = None) -> AgentContext:
    """Return the knowledge of an agent before an episode of an environment, as in a sweep.

    Args:
        env: PointNav, ImageNav, Explore, LidarMaze or CarNav, wrapped or not.
        info: what its ``reset`` returned; of it only the start pose and the camera's matrix are read.
        voxel_map: the learned map, for agents that need one.

    Returns:
        The context: camera, limits, start pose, execution noise and the transition that models the robot.
    """
    world: Any = env.unwrapped
    world = getattr(world, "navigation", world)  # ImageNav moves as the PointNav that it holds
    if (car := getattr(world, "car", None)) is not None:
        return context_of(
            car,
            car.length,
            info["start_pose"],
            success_radius=GOAL_RADIUS,
            noise=world.noise,
            voxel_map=voxel_map,
            camera=world.camera,
            K=info["K"],
            stops=world.end_on == "stop",
        )
    limits = None if hasattr(world, "camera") else world.robot.limits[list(SCANNER_COMMANDS)]
    return context_in(world, info, voxel_map, world.noise, limits)


def context_in(
    world: Any,
    info: dict[str, Any],
    voxel_map: VoxelMap | None,
    noise: KnownNoise,
    limits: np.ndarray | None = None,
    scan_model: ScanModel | None = None,
    scan_encoder: ScanEncoder | None = None,
) -> AgentContext:
    """Build the context of a round robot in a world that was just reset; ``info`` is that of the reset."""
    return context_of(
        world.robot,
        world.robot.body_length,
        info["start_pose"],
        success_radius=getattr(world, "success_radius", 0.0),  # an explorer has no goal
        noise=noise,
        voxel_map=voxel_map,
        camera=getattr(world, "camera", None),  # a scanner's robot has none
        K=info.get("K"),
        limits=limits,
        scan_model=scan_model,
        scan_encoder=scan_encoder,
    )
