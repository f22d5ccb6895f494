"""All that uses MuJoCo: :mod:`physics` moves robots through contacts, :mod:`gl` draws with MuJoCo's renderer.

No module outside this folder imports MuJoCo.
"""

from vssm_gym.envs.mjcf.physics import World, build_spec, obstacles

__all__ = ["World", "build_spec", "obstacles"]
