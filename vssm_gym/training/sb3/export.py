"""Export a policy that stable-baselines3 trained as a policy file, which every sweep runs without torch.

    h_0 = clip((x - mean) / sqrt(var + eps), -c, c) where VecNormalize is used;  the layers as they are

A policy that commands in SI units has its last layer rescaled, so that the file's actions lie in [-1, 1]:

    a' = 2 (a - low) / (high - low) - 1

What cannot be expressed so is refused. ``docs/rl.md`` lists what can.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3
from gymnasium.spaces.utils import flatdim
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.vec_env import VecCheckNan, VecEnv, VecEnvWrapper, VecFrameStack, VecMonitor, VecNormalize
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from vssm_gym.agents.policy.features import OBSERVED, SIZES, size_of
from vssm_gym.agents.policy.policy_file import Normalisation, Policy, PolicySpec, save
from vssm_gym.errors import InputError
from vssm_gym.files.output_folders import check_file
from vssm_gym.training.environment import BODY
from vssm_gym.version import package_version

SOURCE = "export_sb3"  # of errors
ACTIVATION_NAMES = {nn.Tanh: "tanh", nn.ReLU: "relu"}
UNBOUNDED = float(np.finfo(np.float32).max)  # of an input that VecNormalize leaves as it is
POLICY_KINDS = "PPO, A2C, SAC, TD3 or DDPG with MlpPolicy or MultiInputPolicy"


def export_sb3(
    model: BaseAlgorithm, path: str | Path, *, name: str, env: VecEnv | None = None, hfov: float = BODY.hfov
) -> Path:
    """Write the deterministic policy of a model of stable-baselines3 as a policy file (``.npz`` without pickle).

    ``policy:PATH`` is then an agent of sweeps, whose commands are those of ``model.predict(..., deterministic=True)``
    for the same observation. An action's fourth number, a stop, is left out: the agent stops by its own estimate.

    Args:
        model: of PPO, A2C, SAC, TD3 or DDPG, with an MLP of tanh or ReLU layers on the flat observation.
        path: the file to write; replaced if it is there.
        name: in tables; policies that differ by the seed of their training share it.
        env: that the model was trained in, with its wrappers: it says what the inputs are and whether VecNormalize
            scaled them. None: the model's own.
        hfov: rad, angle of the scans of the training.

    Returns:
        ``path``.

    Raises:
        InputError: a policy, an observation, an action or a wrapper that a policy file cannot express.
    """
    path, policy = Path(path), model.policy
    check_file(path, (".npz",))
    trained_in = model.get_env() if env is None else env
    if trained_in is None:
        raise InputError(SOURCE, "env", "the environment of the training: a loaded model has none of its own")
    stack, norm, bottom = _unwrapped(trained_in)
    parts = _parts(bottom)
    frames = 1 if stack is None else flatdim(stack.observation_space) // flatdim(bottom.observation_space)
    network, activation, squash = _network(policy)
    layers = _driving(network, model.action_space, squash)
    inputs = frames * size_of(parts)
    if layers[0][0].shape[1] != inputs:
        found = f"found a first layer of {layers[0][0].shape[1]}"
        raise InputError(SOURCE, "policy", f"{inputs} inputs, {', '.join(parts)}; {found}")
    seen = bottom.observation_space
    scan = seen.spaces.get("scan") if isinstance(seen, gym.spaces.Dict) else None
    spec = PolicySpec(
        name=name,
        parts=parts,
        frames=frames,
        hidden=tuple(len(bias) for _, bias in layers[:-1]),
        activation=activation,
        squash=squash,
        low=tuple(BODY.low.tolist()),
        high=tuple(BODY.high.tolist()),
        max_depth=float(scan.high.max()) if isinstance(scan, gym.spaces.Box) else BODY.max_depth,
        hfov=hfov,
        success_radius=BODY.success_radius,
        trained={
            "algorithm": type(model).__name__.lower(),
            "steps": int(model.num_timesteps),
            "by": f"stable-baselines3 {stable_baselines3.__version__}",
            "version": package_version(),
        },
    )
    save(path, Policy(spec, tuple(layers), None if norm is None else _normalisation(norm, parts)))
    return path


def _unwrapped(env: VecEnv) -> tuple[VecFrameStack | None, VecNormalize | None, VecEnv]:
    """Return what stacks and what normalises observations, and the environment inside; raise for other wrappers."""
    stack, norm = None, None
    while isinstance(env, VecEnvWrapper):
        if isinstance(env, VecFrameStack):
            stack = env
        elif isinstance(env, VecNormalize):
            norm = env if env.norm_obs else norm
        elif not isinstance(env, VecMonitor | VecCheckNan):
            expected = f"VecMonitor, VecNormalize or VecFrameStack; found {type(env).__name__}"
            raise InputError(SOURCE, "env", expected)
        env = env.venv
    if stack is not None and (norm is not None or isinstance(env.observation_space, gym.spaces.Dict)):
        expected = "VecFrameStack on the features of vssm_gym.training.environment alone, without VecNormalize"
        raise InputError(SOURCE, "env", expected)
    return stack, norm, env


def _parts(env: VecEnv) -> tuple[str, ...]:
    """Return the names of the inputs, in the order of the vector."""
    space = env.observation_space
    if isinstance(space, gym.spaces.Dict):
        parts = tuple(f"{OBSERVED}{name}" for name in space.spaces)
        for part, (name, box) in zip(parts, space.spaces.items(), strict=True):
            if SIZES.get(part) is None or box.shape != (SIZES[part],):
                known = ", ".join(sorted(one.removeprefix(OBSERVED) for one in SIZES if one.startswith(OBSERVED)))
                found = f"found {name!r} of shape {box.shape}"
                raise InputError(SOURCE, "observation", f"{known}, as WorldModelNav observes them; {found}")
        if f"{OBSERVED}goal" not in parts or list(parts) != sorted(parts):
            raise InputError(SOURCE, "observation", f"a goal, and sorted names; found {', '.join(space.spaces)}")
        return parts
    try:
        return tuple(part for part in SIZES if part in env.get_attr("parts", 0)[0])
    except AttributeError:
        expected = "a Dict of named parts, or the features of vssm_gym.training.environment"
        raise InputError(SOURCE, "observation", f"{expected}; found {space!s:.80}") from None


def _network(policy: Any) -> tuple[Sequence[nn.Module], str, str]:
    """Return the modules from features to action, the activation between them, and how the last one is bounded."""
    if getattr(policy, "use_sde", False) or getattr(getattr(policy, "actor", None), "use_sde", False):
        raise InputError(SOURCE, "policy", "one without state-dependent exploration (use_sde=False)")
    if isinstance(policy, SACPolicy):
        extractor, modules, squash = policy.actor.features_extractor, [*policy.actor.latent_pi, policy.actor.mu], "tanh"
    elif isinstance(policy, TD3Policy):
        extractor, modules, squash = policy.actor.features_extractor, [*policy.actor.mu][:-1], "tanh"
    elif type(policy).__name__ in ("ActorCriticPolicy", "MultiInputActorCriticPolicy"):
        assert isinstance(policy, ActorCriticPolicy)
        extractor, squash = policy.pi_features_extractor, "clip"
        modules = [*policy.mlp_extractor.policy_net, policy.action_net]
    else:
        raise InputError(SOURCE, "policy", f"{POLICY_KINDS}; found {type(policy).__name__}")
    _check_flat(extractor)
    between = {type(module) for module in modules if not isinstance(module, nn.Linear)}
    if len(between) > 1 or not between <= ACTIVATION_NAMES.keys():
        found = ", ".join(sorted(kind.__name__ for kind in between))
        raise InputError(SOURCE, "policy", f"layers with Tanh or ReLU between them; found {found}")
    return modules, ACTIVATION_NAMES[between.pop()] if between else "tanh", squash


def _check_flat(extractor: nn.Module) -> None:
    """Raise :class:`InputError` for features that a network of its own makes of the observation."""
    made_by = [*extractor.extractors.values()] if type(extractor) is CombinedExtractor else [extractor]
    for one in made_by:
        if type(one) not in (FlattenExtractor, nn.Flatten):
            expected = "the flat observation as features; images need an agent of your own"
            raise InputError(SOURCE, "policy", f"{expected}; found {type(one).__name__}")


def _driving(modules: Sequence[nn.Module], actions: gym.Space, squash: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return weights and biases of the layers; the last one commands (turn, o, s), and -1 and 1 are its ends."""
    if not isinstance(actions, gym.spaces.Box) or actions.shape not in ((3,), (4,)):
        raise InputError(SOURCE, "actions", f"(turn, o, s), with or without a stop; found {actions!s:.80}")
    layers = [
        (one.weight.detach().cpu().numpy().astype(np.float64), one.bias.detach().cpu().numpy().astype(np.float64))
        for one in modules
        if isinstance(one, nn.Linear)
    ]
    low, high = actions.low[:3].astype(np.float64), actions.high[:3].astype(np.float64)
    unit, metric = (-np.ones(3), np.ones(3)), (BODY.low, BODY.high)
    if not any(
        np.allclose(low, ends[0], atol=1e-6) and np.allclose(high, ends[1], atol=1e-6) for ends in (unit, metric)
    ):
        expected = f"bounds of -1 and 1, or the holonomic robot's {np.round(BODY.low, 4).tolist()} and"
        expected += f" {np.round(BODY.high, 4).tolist()}"
        raise InputError(SOURCE, "actions", f"{expected}; found {low.round(4).tolist()} and {high.round(4).tolist()}")
    weight, bias = (array[:3] for array in layers[-1])
    if squash == "clip":  # of a squashed action -1 and 1 are the ends already
        scale = 2.0 / (high - low)
        weight, bias = scale[:, None] * weight, scale * (bias - low) - 1.0
    layers[-1] = weight, bias
    return [(weight.astype(np.float32), bias.astype(np.float32)) for weight, bias in layers]


def _normalisation(norm: VecNormalize, parts: Sequence[str]) -> Normalisation:
    """Return what VecNormalize does to each input; those of keys that it leaves out pass unchanged."""
    shift, scale, bound = [], [], []
    for part in parts:
        size, key = SIZES[part], part.removeprefix(OBSERVED)
        if isinstance(norm.obs_rms, dict):
            known = norm.obs_rms.get(key)
            mean, variance = (np.zeros(size), None) if known is None else (known.mean, known.var)
        else:
            mean, variance = norm.obs_rms.mean, norm.obs_rms.var
        shift.append(mean)
        scale.append(np.ones(size) if variance is None else np.sqrt(variance + norm.epsilon))
        bound.append(np.full(len(mean), UNBOUNDED if variance is None else norm.clip_obs))
        if not isinstance(norm.obs_rms, dict):
            break  # of the whole vector
    return Normalisation(*(np.concatenate(arrays) for arrays in (shift, scale, bound)))
