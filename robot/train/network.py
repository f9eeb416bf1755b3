"""A small network from features to an action: what a laptop can train, and a robot run in microseconds."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

CLIP = 5.0  # deviations from the mean
PICTURES = ("maps", "flow")  # channels first; the other features are plain numbers
OF_PICTURES = 64  # numbers that a picture is brought to

Shapes = Mapping[str, tuple[int, ...]]


class FeatureLayers(nn.Module):
    """Features (each with a leading batch axis, in the order of `keys`) -> (batch, `size`).

    Normalisation is inside: each channel of maps and each number less its mean, over its deviation, cut at CLIP.

    Args:
        shapes: of the features without the batch axis, by name.
    """

    def __init__(self, shapes: Shapes) -> None:
        super().__init__()
        self.keys = tuple(sorted(shapes))
        self.pictures = nn.ModuleDict({key: _picture_layers(shapes[key]) for key in self.keys if key in PICTURES})
        self.size = 0
        for key in self.keys:
            channels = shapes[key][0]
            self.register_buffer(f"mean_{key}", torch.zeros(channels))
            self.register_buffer(f"deviation_{key}", torch.ones(channels))
            self.size += OF_PICTURES if key in PICTURES else channels

    def forward(self, *features: Tensor) -> Tensor:
        parts = []
        for key, value in zip(self.keys, features, strict=True):
            mean, deviation = getattr(self, f"mean_{key}"), getattr(self, f"deviation_{key}")
            if key in PICTURES:
                mean, deviation = mean[:, None, None], deviation[:, None, None]
            normal = torch.clamp((value - mean) / deviation, -CLIP, CLIP)
            parts.append(self.pictures[key](normal) if key in PICTURES else normal)
        return torch.cat(parts, dim=1)

    def normalise_by(self, seen: Mapping[str, Tensor]) -> None:
        """Takes mean and deviation from examples (batch, ...); what hardly varies is left at its own size."""
        for key in self.keys:
            axes = (0, 2, 3) if key in PICTURES else (0,)
            getattr(self, f"mean_{key}").copy_(seen[key].mean(dim=axes))
            deviation = seen[key].std(dim=axes, unbiased=False)
            getattr(self, f"deviation_{key}").copy_(
                torch.where(deviation > 1e-3, deviation, torch.ones_like(deviation))
            )


class PolicyNetwork(nn.Module):
    """Features, in the order of `keys` -> actions (batch, n) within [-1, 1].

    Args:
        cut: what is beyond is cut, as PPO does; otherwise a hyperbolic tangent brings everything within.
    """

    def __init__(self, shapes: Shapes, actions: int, width: int, *, cut: bool = False) -> None:
        super().__init__()
        self._cut = cut
        self.layers = FeatureLayers(shapes)
        self.keys = self.layers.keys
        self.head = nn.Sequential(
            nn.Linear(self.layers.size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, actions)
        )

    def forward(self, *features: Tensor) -> Tensor:
        raw: Tensor = self.head(self.layers(*features))
        return torch.clamp(raw, -1.0, 1.0) if self._cut else torch.tanh(raw)


def _picture_layers(shape: tuple[int, ...]) -> nn.Sequential:
    """(batch, *shape) -> (batch, OF_PICTURES)."""
    channels, rows, columns = shape
    layers = nn.Sequential(
        nn.Conv2d(channels, 16, 3, stride=2, padding=1), nn.ReLU(),
        nn.Conv2d(16, 32, 3, stride=2, padding=1), nn.ReLU(),
        nn.Flatten(),
    )  # fmt: skip
    with torch.no_grad():
        size = layers(torch.zeros(1, channels, rows, columns)).shape[1]
    return nn.Sequential(layers, nn.Linear(size, OF_PICTURES), nn.ReLU())
