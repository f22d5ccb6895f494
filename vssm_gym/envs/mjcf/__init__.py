"""All that uses MuJoCo: :mod:`physics` moves robots through contacts, :mod:`gl` draws with MuJoCo's renderer, and
:mod:`static_geoms` compiles the models that people bring.

No module outside this folder imports MuJoCo.
"""

from vssm_gym.envs.mjcf.physics import World, build_spec, obstacles
from vssm_gym.envs.mjcf.static_geoms import StaticGeom, static_geoms

__all__ = ["StaticGeom", "World", "build_spec", "obstacles", "static_geoms"]
