"""Clone behaviour: ``min_theta mean |policy_theta(x) - a|^2`` over an expert's demonstrations (Pomerleau, 1989)."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import nn

from vssm_gym.training.run import LEAST_RATE
from vssm_gym.training.sb3.learner import ACTIVATIONS

Layers = tuple[tuple[np.ndarray, np.ndarray], ...]


def fit(
    vectors: np.ndarray,
    actions: np.ndarray,
    hidden: Sequence[int],
    activation: str,
    *,
    epochs: int,
    batch_size: int,
    learning_rate: float,
    seed: int,
    on_epoch: Callable[[int, float], None],
    stop: Callable[[], bool],
) -> Layers:
    """Fit an MLP by Adam with a linearly falling rate; end early when ``stop()`` is true.

    Args:
        vectors: ``(n, inputs)`` inputs of the policy.
        actions: ``(n, 3)`` in [-1, 1].
        hidden: widths of the hidden layers.
        activation: between them.
        epochs: passes over the data.
        batch_size: of a step.
        learning_rate: the initial one.
        seed: of the initial network and the order.
        on_epoch: called with the epoch and its mean loss.
        stop: returns whether to end now.

    Returns:
        ``(weight, bias)`` of each layer, float32.
    """
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    widths = [vectors.shape[1], *hidden, actions.shape[1]]
    linear = [nn.Linear(n, m) for n, m in pairwise(widths)]
    network = nn.Sequential(*(part for one in linear for part in (one, ACTIVATIONS[activation]())))[:-1]
    optimiser = torch.optim.Adam(network.parameters(), learning_rate)
    falling = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, LEAST_RATE, epochs)
    x, a = torch.from_numpy(vectors), torch.from_numpy(actions)
    for epoch in range(epochs):
        if stop():
            break
        losses = []
        for rows in torch.randperm(len(x), generator=generator).split(batch_size):
            loss = nn.functional.mse_loss(network(x[rows]), a[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            losses.append(loss.item() * len(rows))
        falling.step()
        on_epoch(epoch + 1, sum(losses) / len(x))
    return tuple((one.weight.detach().numpy().copy(), one.bias.detach().numpy().copy()) for one in linear)
