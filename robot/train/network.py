"""A small network from features to an action: what a laptop can train, and a robot run in microseconds."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

CLIP = 5.0  # deviations from the mean
PICTURES = ("maps", "flow")  # channels first; the other features are plain numbers


class PolicyNetwork(nn.Module):
    """Features (each with a leading batch axis) -> actions (batch, n) within [-1, 1].

    Normalisation is inside: each channel of maps and each number less its mean, over its deviation, cut at CLIP.

    Args:
        shapes: of the features without the batch axis, by name.
    """

    def __init__(self, shapes: Mapping[str, tuple[int, ...]], actions: int, width: int = 128) -> None:
        super().__init__()
        self.keys = tuple(sorted(shapes))
        self.pictures = nn.ModuleDict()
        features = 0
        for key in self.keys:
            channels = shapes[key][0]
            self.register_buffer(f"mean_{key}", torch.zeros(channels))
            self.register_buffer(f"deviation_{key}", torch.ones(channels))
            if key in PICTURES:
                self.pictures[key] = _picture_layers(shapes[key])
                features += 64
            else:
                features += channels
        self.head = nn.Sequential(
            nn.Linear(features, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, actions)
        )

    def forward(self, *features: Tensor) -> Tensor:
        """`features` in the order of `keys`."""
        parts = []
        for key, value in zip(self.keys, features, strict=True):
            mean, deviation = getattr(self, f"mean_{key}"), getattr(self, f"deviation_{key}")
            if key in PICTURES:
                mean, deviation = mean[:, None, None], deviation[:, None, None]
            normal = torch.clamp((value - mean) / deviation, -CLIP, CLIP)
            parts.append(self.pictures[key](normal) if key in PICTURES else normal)
        action: Tensor = torch.tanh(self.head(torch.cat(parts, dim=1)))
        return action

    def normalise_by(self, seen: Mapping[str, Tensor]) -> None:
        """Takes mean and deviation from examples (batch, ...); what hardly varies is left at its own size."""
        for key in self.keys:
            axes = (0, 2, 3) if key in PICTURES else (0,)
            getattr(self, f"mean_{key}").copy_(seen[key].mean(dim=axes))
            deviation = seen[key].std(dim=axes, unbiased=False)
            getattr(self, f"deviation_{key}").copy_(
                torch.where(deviation > 1e-3, deviation, torch.ones_like(deviation))
            )


def _picture_layers(shape: tuple[int, ...]) -> nn.Sequential:
    """(batch, *shape) -> (batch, 64)."""
    channels, rows, columns = shape
    layers = nn.Sequential(
        nn.Conv2d(channels, 16, 3, stride=2, padding=1), nn.ReLU(),
        nn.Conv2d(16, 32, 3, stride=2, padding=1), nn.ReLU(),
        nn.Flatten(),
    )  # fmt: skip
    with torch.no_grad():
        size = layers(torch.zeros(1, channels, rows, columns)).shape[1]
    return nn.Sequential(layers, nn.Linear(size, 64), nn.ReLU())
