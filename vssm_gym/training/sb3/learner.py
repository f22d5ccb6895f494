"""Make, run, save and restore PPO and SAC of stable-baselines3 on feature vectors, and extract their networks.

A checkpoint is written by ``torch.save`` and read with ``weights_only=True``: parameters, optimisers, counters and the
states of the random generators, no code. stable-baselines3's own ``.zip`` files hold pickles and are not used.
"""

import importlib.util
import io
import random
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecMonitor
from torch import nn

from vssm_gym.errors import InputError
from vssm_gym.files.atomic import atomic_write
from vssm_gym.training.run import WINDOW, TrainingProgress, falling_rate
from vssm_gym.training.sb3.vec_env import SB3VecEnv

ACTIVATIONS = {"tanh": nn.Tanh, "relu": nn.ReLU}
COUNTERS = ("num_timesteps", "_n_updates")  # what a checkpoint restores by name, and nothing else
REFUSED = "found invalid values"  # in torch's error, of a density of a network that has diverged
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def wrapped(env: VectorEnv, frames: int) -> VecEnv:
    """Wrap a vector environment for stable-baselines3, with the last ``frames`` observations stacked."""
    monitored = VecMonitor(SB3VecEnv(env))
    return VecFrameStack(monitored, frames) if frames > 1 else monitored


def make_model(
    algorithm: str,
    env: VecEnv,
    hidden: Sequence[int],
    activation: str,
    seed: int,
    settings: Mapping[str, Any],
    fraction_done: Callable[[], float],
    log_folder: Path,
) -> BaseAlgorithm:
    """Make ``ppo`` or ``sac`` with an MLP for the policy and one of the same size for the values.

    Args:
        algorithm: ``ppo`` or ``sac``.
        env: of :func:`wrapped`; actions in [-1, 1].
        hidden: widths of the hidden layers.
        activation: between them, ``tanh`` or ``relu``.
        seed: of network, exploration and environments.
        settings: the algorithm's own arguments; the learning rate falls linearly to LEAST_RATE of it, and
            ``log_std_init`` is PPO's first standard deviation.
        fraction_done: returns the fraction of the training that is done, in [0, 1].
        log_folder: for TensorBoard's events where it is installed, else for ``progress.csv``.
    """
    arguments = dict(settings)
    rate = float(arguments.pop("learning_rate"))
    network: dict[str, Any] = {"net_arch": list(hidden), "activation_fn": ACTIVATIONS[activation]}
    if algorithm == "ppo":
        network |= {"net_arch": {"pi": list(hidden), "vf": list(hidden)}}
        network |= {"log_std_init": arguments.pop("log_std_init")}
    model = {"ppo": PPO, "sac": SAC}[algorithm](
        "MlpPolicy",
        env,
        # The schedule's own argument counts steps only, not time
        learning_rate=lambda _: falling_rate(rate, fraction_done()),
        policy_kwargs=network,
        seed=seed,
        device="cpu",  # networks this small are slower anywhere else
        stats_window_size=WINDOW,
        **arguments,
    )
    form = "tensorboard" if importlib.util.find_spec("tensorboard") else "csv"
    model.set_logger(configure(str(log_folder), [form]))
    return model


class _Watch(BaseCallback):
    """Report between updates, and end the training there, so that no rollout is discarded."""

    def __init__(
        self, on_update: Callable[[TrainingProgress], None], stop: Callable[[], bool], stepped: Callable[[], None]
    ) -> None:
        super().__init__()
        self._on_update, self._stop, self._stepped, self._between = on_update, stop, stepped, True

    def _on_rollout_start(self) -> None:
        self._between = True
        self._on_update(training_progress(self.model))

    def _on_step(self) -> bool:
        self._stepped()
        goes_on = not (self._between and self._stop())
        self._between = False
        return goes_on


def learn(
    model: BaseAlgorithm,
    steps: int,
    on_update: Callable[[TrainingProgress], None],
    stop: Callable[[], bool],
    stepped: Callable[[], None],
) -> None:
    """Train until ``steps`` in all, or until ``stop()`` is true.

    Call ``stepped`` after every step of all robots, and ``on_update`` after every update.
    """
    left = steps - model.num_timesteps
    if left > 0 and not stop():
        model.learn(left, callback=_Watch(on_update, stop, stepped), reset_num_timesteps=False, log_interval=1)


def training_progress(model: BaseAlgorithm) -> TrainingProgress:
    """Return the progress of the training of ``model``."""
    ended, successes = model.ep_info_buffer or (), model.ep_success_buffer or ()
    mean = lambda values: float(np.mean(values)) if len(values) else None
    returns, lengths = [one["r"] for one in ended], [one["l"] for one in ended]
    return TrainingProgress(model.num_timesteps, len(ended), mean(returns), mean(lengths), mean(successes))


def save_checkpoint(path: Path, model: BaseAlgorithm, seconds: float) -> None:
    """Save everything that the training resumes from, whole or not at all."""
    names, variables = model._get_torch_save_params()
    kind, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002  (stable-baselines3 draws from it)
    version, words, spare = random.getstate()
    content: dict[str, Any] = {
        "parameters": {name: value for name, value in model.get_parameters().items() if name in names},
        "variables": {name: getattr(model, name).detach() for name in variables},
        "counters": {name: getattr(model, name, 0) for name in COUNTERS},
        "seconds": seconds,
        "torch": torch.get_rng_state(),
        "numpy": [kind, torch.from_numpy(np.asarray(keys, np.int64)), position, has_gauss, gauss],
        "python": [version, list(words), spare],
    }
    if isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
        buffer = model.replay_buffer
        rows = slice(None) if buffer.full else slice(0, buffer.pos)
        content["replay"] = {name: torch.from_numpy(getattr(buffer, name)[rows]) for name in REPLAY}
        content["replay_at"] = [buffer.pos, buffer.full]
    with atomic_write(path) as temporary:
        torch.save(content, temporary)


def restore_checkpoint(path: Path, model: BaseAlgorithm) -> float:
    """Restore a checkpoint of the same configuration; return the seconds trained so far.

    Raises :class:`InputError` for a file that is not a checkpoint, or one of another network.
    """
    try:
        content = torch.load(io.BytesIO(path.read_bytes()), weights_only=True)
        model.set_parameters(content["parameters"], exact_match=True, device="cpu")
        variables, counters = content["variables"], content["counters"]
        if set(variables) != set(model._get_torch_save_params()[1]) or set(counters) != set(COUNTERS):
            raise ValueError(f"it holds {', '.join(sorted({*variables, *counters}))}")
        for name, value in variables.items():
            getattr(model, name).data.copy_(value)
        model.num_timesteps, updates = (_count(counters[name]) for name in COUNTERS)
        if hasattr(model, "_n_updates"):
            model._n_updates = updates
        torch.set_rng_state(content["torch"])
        kind, keys, *rest = content["numpy"]
        np.random.set_state((kind, keys.numpy().astype(np.uint32), *rest))  # noqa: NPY002
        version, words, spare = content["python"]
        random.setstate((version, tuple(words), spare))
        if "replay" in content and isinstance(model, OffPolicyAlgorithm) and model.replay_buffer is not None:
            buffer = model.replay_buffer
            for name in REPLAY:
                value = content["replay"][name]
                getattr(buffer, name)[: len(value)] = value.numpy()
            position, full = content["replay_at"]
            buffer.pos, buffer.full = _count(position) % buffer.buffer_size, bool(full)
        return float(content["seconds"])
    except Exception as error:  # torch raises many kinds for files that are not its own
        expected = f"a checkpoint of this training, which `vssm-gym train` wrote ({' '.join(str(error).split()):.100})"
        raise InputError(path, "file", expected) from error


def _count(value: Any) -> int:
    """Return a count of a checkpoint; raise ValueError for anything else."""
    if type(value) is not int or not 0 <= value < 2**53:
        raise ValueError(f"a count; found {value!r:.40}")
    return value


def layers_of(model: BaseAlgorithm) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Return ``(weight, bias)`` of each layer from observation to action, float32."""
    network: Any = model.policy
    if isinstance(model, SAC):
        modules = [*network.actor.latent_pi, network.actor.mu]
    else:
        modules = [*network.mlp_extractor.policy_net, network.action_net]
    taken = [(one.weight, one.bias) for one in modules if isinstance(one, nn.Linear)]
    return tuple((weight.detach().numpy().copy(), bias.detach().numpy().copy()) for weight, bias in taken)
