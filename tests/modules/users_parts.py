"""Parts as a user writes them, in a module of their own: a decoder, a skill encoder, and features of pictures."""

import torch
from tensordict.nn import TensorDictModuleBase
from torch import nn

from lw_torchrl.modules import Features


class Gated(nn.Module):
    """A decoder (B, D + F) -> (B, A)."""

    def __init__(self, hidden: int = 8) -> None:
        super().__init__()
        self.config = {"hidden": hidden}
        self.value, self.gate, self.last = nn.LazyLinear(hidden), nn.LazyLinear(hidden), nn.Linear(hidden, 4)

    def forward(self, encoding: torch.Tensor) -> torch.Tensor:
        return torch.tanh(self.last(self.value(encoding) * self.gate(encoding).sigmoid()))


class Projection(nn.Module):
    """A skill encoder (K, E) -> (K, D)."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.config = {"size": size}
        self.net = nn.LazyLinear(size)

    def forward(self, vectors: torch.Tensor) -> torch.Tensor:
        return self.net(vectors)


class Pictures(Features):
    """Features of pictures, by a convolution."""

    def __init__(self, channels: int = 4, noise: float = 0.0) -> None:
        super().__init__(noise, ["pixels"])
        self.config, self.width = {"channels": channels, "noise": noise}, channels
        self.net = nn.Sequential(nn.Conv2d(3, channels, 3, 2), nn.ReLU(), nn.AdaptiveAvgPool2d(1), nn.Flatten())

    def compute(self, tensordict: torch.Tensor) -> torch.Tensor:
        pixels = tensordict["pixels"]
        seen = self.net(pixels.flatten(0, -4).movedim(-1, -3) / 255)
        return seen.reshape(*pixels.shape[:-3], self.width)


class Closest(TensorDictModuleBase):
    """A decoder that is a TensorDict module and reads more than latent and features."""

    def __init__(self, gain: float = 10.0) -> None:
        super().__init__()
        self.config = {"gain": gain}
        self.in_keys, self.out_keys = ["skill_latent", "features", "observation"], ["action"]
        self.gain = nn.Parameter(torch.tensor(gain))

    def forward(self, tensordict):
        observation = tensordict["observation"]
        away = (observation[..., 4:7] - observation[..., :3]) * self.gain
        effort = torch.tanh(tensordict["skill_latent"].mean(-1, keepdim=True))
        return tensordict.set("action", torch.cat((away, effort), -1).clamp(-1, 1))
