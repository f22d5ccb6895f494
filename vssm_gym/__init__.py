"""vssm_gym: indoor Gymnasium environments, a spatial world model inferred in real time, and agents that plan in it.

Importing the package registers its environments (``vssm_gym/PointNav-v0``); JAX and MuJoCo are imported when used.
"""

from vssm_gym.envs.registration import register

__version__ = "0.1.0"

register()
