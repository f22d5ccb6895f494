"""Connect environments to stable-baselines3 (the extra ``vssm-gym[rl]``): features, vector environment, learner.

    env = SB3VecEnv(gym.make_vec("vssm_gym/PointNav-v0", num_envs=8, observe_pose=True, end_on="reach"))
    PPO("MultiInputPolicy", env, policy_kwargs={"features_extractor_class": RGBDExtractor}).learn(1_000_000)

    export_sb3(model, "ppo.npz", name="ppo")  # an agent of sweeps, policy:ppo.npz

``learner`` and ``cloning`` are used by ``vssm-gym train``. This folder alone imports torch. Docs: ``docs/rl.md``.
"""

from vssm_gym.training.sb3.export import export_sb3
from vssm_gym.training.sb3.extractor import RGBDExtractor
from vssm_gym.training.sb3.vec_env import SB3VecEnv

__all__ = ["RGBDExtractor", "SB3VecEnv", "export_sb3"]
