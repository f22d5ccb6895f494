"""vssm_gym: indoor Gymnasium environments, a spatial world model inferred in real time, and agents that plan in it.

Importing the package registers its environments (``gymnasium.make("vssm_gym/PointNav-v0")``), turns on JAX's cache of
compiled functions (:mod:`vssm_gym.compilation_cache`), lets libraries use the same instructions on every processor
(:mod:`vssm_gym.instruction_set`) and JAX all digits of float32 on a GPU (:mod:`vssm_gym.gpu_defaults`). Every public
name of :data:`PUBLIC` is imported from its module when it is first used, and JAX and MuJoCo with it.

    import vssm_gym as vg

    m = vg.map_from_frames(frames, T_world_cam, camera)
    image = vg.render(m, T_world_cam[0], camera)

``docs/library.md`` shows them at work. Everything else in the package is internal and may change.
"""

import importlib
from typing import TYPE_CHECKING, Any

from vssm_gym.compilation_cache import use_compilation_cache
from vssm_gym.envs.registration import register
from vssm_gym.gpu_defaults import use_gpu_defaults
from vssm_gym.instruction_set import use_common_instructions
from vssm_gym.version import __version__

if TYPE_CHECKING:  # the same names for type checkers and editors; tests/test_api.py holds the two lists together
    from vssm_gym.agents.base import AgentContext as AgentContext
    from vssm_gym.agents.base import Decision as Decision
    from vssm_gym.agents.registry import make_agent as make_agent
    from vssm_gym.agents.registry import register_agent as register_agent
    from vssm_gym.cli.shared.shown_sweep import run_sweep as run_sweep
    from vssm_gym.data.sequences import load_sequence as load_sequence
    from vssm_gym.data.trajectories import write_trajectory as write_trajectory
    from vssm_gym.envs.scenes.scene import load_scene as load_scene
    from vssm_gym.errors import InputError as InputError
    from vssm_gym.eval.protocols.agent_context import agent_context as agent_context
    from vssm_gym.eval.sweep.config import load_config as load_config
    from vssm_gym.geometry.camera import Camera as Camera
    from vssm_gym.inference.filter import Rig as Rig
    from vssm_gym.inference.prism.config import PrismConfig as PrismConfig
    from vssm_gym.inference.prism.filter import Prism as Prism
    from vssm_gym.inference.registry import make_filter as make_filter
    from vssm_gym.inference.tracking.map_tracker import MapTracker as MapTracker
    from vssm_gym.maps.voxel_map import VoxelMap as VoxelMap
    from vssm_gym.model.emission import RGBD as RGBD
    from vssm_gym.model.emission import render as render
    from vssm_gym.model.posterior import Posterior as Posterior
    from vssm_gym.model.spatial_model import SpatialModel as SpatialModel
    from vssm_gym.model.spatial_model import rollout as rollout
    from vssm_gym.model.transition.base import Transition as Transition
    from vssm_gym.model.transition.belief import GaussianBelief as GaussianBelief
    from vssm_gym.model.transition.bicycle import Bicycle as Bicycle
    from vssm_gym.model.transition.bicycle import BicycleNoise as BicycleNoise
    from vssm_gym.model.transition.differential import DifferentialDrive as DifferentialDrive
    from vssm_gym.model.transition.differential import DifferentialNoise as DifferentialNoise
    from vssm_gym.model.transition.imu import Imu as Imu
    from vssm_gym.model.transition.imu import ImuNoise as ImuNoise
    from vssm_gym.model.transition.motion_noise import MotionNoise as MotionNoise
    from vssm_gym.model.transition.planar import Planar as Planar
    from vssm_gym.model.transition.rigid import Rigid as Rigid
    from vssm_gym.model.transition.rigid import RigidNoise as RigidNoise
    from vssm_gym.planning.clearance import ClearanceMap as ClearanceMap
    from vssm_gym.planning.planners import plan as plan
    from vssm_gym.planning.result import PlanResult as PlanResult
    from vssm_gym.slam.map_building import build_map as build_map
    from vssm_gym.slam.map_building import map_from_frames as map_from_frames
    from vssm_gym.slam.options import SlamOptions as SlamOptions
    from vssm_gym.slam.run import run_slam as run_slam
else:  # a checker that saw these two would accept any misspelt name

    def __getattr__(name: str) -> Any:
        """Import a public name at its first use (PEP 562)."""
        if name not in PUBLIC:
            raise AttributeError(f"module 'vssm_gym' has no attribute {name!r}")
        value = getattr(importlib.import_module(PUBLIC[name]), name)
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        """List the public names, imported or not."""
        return sorted({*globals(), *PUBLIC})


PUBLIC: dict[str, str] = {
    # images and maps
    "Camera": "vssm_gym.geometry.camera",
    "RGBD": "vssm_gym.model.emission",
    "VoxelMap": "vssm_gym.maps.voxel_map",
    "map_from_frames": "vssm_gym.slam.map_building",
    "render": "vssm_gym.model.emission",
    # the model: its transitions, its beliefs, its futures
    "Transition": "vssm_gym.model.transition.base",
    "Planar": "vssm_gym.model.transition.planar",
    "MotionNoise": "vssm_gym.model.transition.motion_noise",
    "Bicycle": "vssm_gym.model.transition.bicycle",
    "BicycleNoise": "vssm_gym.model.transition.bicycle",
    "DifferentialDrive": "vssm_gym.model.transition.differential",
    "DifferentialNoise": "vssm_gym.model.transition.differential",
    "Rigid": "vssm_gym.model.transition.rigid",
    "RigidNoise": "vssm_gym.model.transition.rigid",
    "Imu": "vssm_gym.model.transition.imu",
    "ImuNoise": "vssm_gym.model.transition.imu",
    "GaussianBelief": "vssm_gym.model.transition.belief",
    "Posterior": "vssm_gym.model.posterior",
    "SpatialModel": "vssm_gym.model.spatial_model",
    "rollout": "vssm_gym.model.spatial_model",
    # inference
    "Rig": "vssm_gym.inference.filter",
    "make_filter": "vssm_gym.inference.registry",
    "Prism": "vssm_gym.inference.prism.filter",
    "PrismConfig": "vssm_gym.inference.prism.config",
    "MapTracker": "vssm_gym.inference.tracking.map_tracker",
    # recordings
    "load_sequence": "vssm_gym.data.sequences",
    "build_map": "vssm_gym.slam.map_building",
    "run_slam": "vssm_gym.slam.run",
    "SlamOptions": "vssm_gym.slam.options",
    "write_trajectory": "vssm_gym.data.trajectories",
    # planning
    "ClearanceMap": "vssm_gym.planning.clearance",
    "plan": "vssm_gym.planning.planners",
    "PlanResult": "vssm_gym.planning.result",
    # environments, agents, evaluation
    "load_scene": "vssm_gym.envs.scenes.scene",
    "make_agent": "vssm_gym.agents.registry",
    "register_agent": "vssm_gym.agents.registry",
    "AgentContext": "vssm_gym.agents.base",
    "agent_context": "vssm_gym.eval.protocols.agent_context",
    "Decision": "vssm_gym.agents.base",
    "load_config": "vssm_gym.eval.sweep.config",
    "run_sweep": "vssm_gym.cli.shared.shown_sweep",
    "InputError": "vssm_gym.errors",
}
"""The public names, and the module that defines each."""

__all__ = ["__version__", *PUBLIC]

use_common_instructions()  # before Gymnasium loads NumPy
use_compilation_cache()
use_gpu_defaults()
register()
