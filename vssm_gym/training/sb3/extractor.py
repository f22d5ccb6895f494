"""Extract features of RGB-D images, goals and poses for policies of stable-baselines3."""

import gymnasium as gym
import torch
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from vssm_gym.errors import InputError

METRES = 10.0  # m, unit of goals and poses: the size of an apartment


class RGBDExtractor(BaseFeaturesExtractor):
    """``features = MLP([CNN(rgb, clip(depth / max_depth), depth > 0), MLP(goal[, pose])])``.

    The image has five channels, or two without ``rgb``: colour in [0, 1] as stable-baselines3 hands it over, depth in
    [0, 1], and whether there was a reading, so that "no reading" is not mistaken for a depth of zero. Four
    convolutions of stride two take images of any size. The goal is ``(x, y)`` in m, or the ``(distance, cos, sin)`` of
    :class:`vssm_gym.envs.wrappers.RelativeGoal`; a pose enters as ``(x, y, cos, sin)``.

    Args:
        observation_space: ``Dict(depth[, rgb][, goal][, pose])``; ``rgb`` with channels first, as stable-baselines3's
            policies have it after their own transposition.
        features_dim: length of the feature vector.
        max_depth: depth (m) that is scaled to 1; farther ones are clipped. 1 for depth that
            :class:`vssm_gym.envs.wrappers.NormalizedDepth` scaled.
    """

    def __init__(self, observation_space: gym.spaces.Dict, features_dim: int = 256, max_depth: float = 5.0) -> None:
        super().__init__(observation_space, features_dim)
        shapes = _checked(observation_space)
        if not max_depth > 0.0:
            raise InputError("RGBDExtractor", "max_depth", f"a positive number of metres; found {max_depth!r}")
        self.max_depth = max_depth
        first = channels = 5 if "rgb" in shapes else 2
        layers: list[nn.Module] = []
        for width in (32, 64, 64, 64):
            layers += [nn.Conv2d(channels, width, kernel_size=3, stride=2, padding=1), nn.ReLU()]
            channels = width
        self.cnn = nn.Sequential(*layers, nn.Flatten())
        with torch.no_grad():
            seen = self.cnn(torch.zeros(1, first, *shapes["depth"])).shape[1]
        numbers = shapes.get("goal", (0,))[0] + (4 if "pose" in shapes else 0)
        self.mlp = nn.Sequential(nn.Linear(numbers, 64), nn.ReLU()) if numbers else None
        self.join = nn.Sequential(nn.Linear(seen + (64 if numbers else 0), features_dim), nn.ReLU())

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Compute features ``(batch, features_dim)`` of preprocessed observations."""
        parts = [self.cnn(self.image(observations))]
        if self.mlp is not None:
            parts.append(self.mlp(self.numbers(observations)))
        return self.join(torch.cat(parts, dim=1))

    def image(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Stack ``(batch, 5 or 2, height, width)``: colour if there is one, scaled depth, validity of depth."""
        depth = observations["depth"][:, None]
        channels = [torch.clamp(depth / self.max_depth, 0.0, 1.0), (depth > 0.0).to(depth.dtype)]
        if "rgb" in observations:
            channels.insert(0, observations["rgb"])
        return torch.cat(channels, dim=1)

    @staticmethod
    def numbers(observations: dict[str, torch.Tensor]) -> torch.Tensor:
        """Stack ``(batch, n)``: goal and pose, lengths over :data:`METRES`, headings as cosine and sine."""
        parts = []
        if "goal" in observations:
            goal = observations["goal"]
            lengths = 2 if goal.shape[1] == 2 else 1  # (x, y), or (distance, cos, sin)
            parts += [goal[:, :lengths] / METRES, goal[:, lengths:]]
        if "pose" in observations:
            pose = observations["pose"]
            parts += [pose[:, :2] / METRES, torch.cos(pose[:, 2:]), torch.sin(pose[:, 2:])]
        return torch.cat(parts, dim=1)


def _checked(space: gym.spaces.Dict) -> dict[str, tuple[int, ...]]:
    """Return the shapes of an observation's parts; raise :class:`InputError` for parts that cannot be read."""
    parts = space.spaces if isinstance(space, gym.spaces.Dict) else {}
    shapes = {key: part.shape or () for key, part in parts.items()}
    if len(shapes.get("depth", ())) != 2:
        raise InputError("RGBDExtractor", "depth", f"an image (height, width) among the observations; found {space}")
    if "rgb" in shapes and shapes["rgb"] != (3, *shapes["depth"]):
        expected = f"channels first, of the depth image's size, {(3, *shapes['depth'])}; found {shapes['rgb']}"
        raise InputError("RGBDExtractor", "rgb", expected)
    if unknown := set(shapes) - {"depth", "rgb", "goal", "pose"}:
        raise InputError("RGBDExtractor", "observation_space", f"depth, rgb, goal, pose; found {sorted(unknown)} too")
    return shapes
