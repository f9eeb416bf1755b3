"""A small network from features to an action, which a laptop can train, and its export to ONNX."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from robot.common.whole_file import write_whole
from tacsim.models.policy import METADATA_KEY, PolicySpec

MAX_DEVIATIONS = 5.0  # from the mean; larger ones are clipped
PICTURES = ("maps", "flow")  # channels first; the other features are plain numbers
PICTURE_FEATURES = 64  # numbers per picture after its layers

Shapes = Mapping[str, tuple[int, ...]]
MAX_BYTES = 2 * 2**20
EXAMPLES = 64


class FeatureLayers(nn.Module):
    """Maps features (each with a leading batch axis, in the order of `keys`) to (batch, `size`).

    It includes the normalisation: each channel and each number minus its mean, divided by its standard deviation,
    clipped at MAX_DEVIATIONS.

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
            self.size += PICTURE_FEATURES if key in PICTURES else channels

    def forward(self, *features: Tensor) -> Tensor:
        parts = []
        for key, value in zip(self.keys, features, strict=True):
            mean, deviation = getattr(self, f"mean_{key}"), getattr(self, f"deviation_{key}")
            if key in PICTURES:
                mean, deviation = mean[:, None, None], deviation[:, None, None]
            normal = torch.clamp((value - mean) / deviation, -MAX_DEVIATIONS, MAX_DEVIATIONS)
            parts.append(self.pictures[key](normal) if key in PICTURES else normal)
        return torch.cat(parts, dim=1)

    def normalise_by(self, examples: Mapping[str, Tensor]) -> None:
        """Sets mean and deviation from `examples` (batch, ...)."""
        axes = {key: (0, 2, 3) if key in PICTURES else (0,) for key in self.keys}
        self.set_moments(
            {
                key: (examples[key].mean(dim=axes[key]), examples[key].std(dim=axes[key], unbiased=False))
                for key in self.keys
            }
        )

    def set_moments(self, moments: Mapping[str, tuple[Tensor, Tensor]]) -> None:
        """Sets mean and deviation (channels,) of each key; deviations up to 1e-3 are replaced by 1."""
        for key in self.keys:
            mean, deviation = moments[key]
            getattr(self, f"mean_{key}").copy_(mean)
            getattr(self, f"deviation_{key}").copy_(
                torch.where(deviation > 1e-3, deviation, torch.ones_like(deviation))
            )


class PolicyNetwork(nn.Module):
    """Maps features, in the order of `keys`, to actions (batch, n) within [-1, 1].

    Args:
        clip: clip to the range, as PPO does; otherwise a hyperbolic tangent maps to it.
    """

    def __init__(self, shapes: Shapes, actions: int, width: int, *, clip: bool = False) -> None:
        super().__init__()
        self._clip = clip
        self.layers = FeatureLayers(shapes)
        self.keys = self.layers.keys
        self.head = nn.Sequential(
            nn.Linear(self.layers.size, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, actions)
        )

    def forward(self, *features: Tensor) -> Tensor:
        raw: Tensor = self.head(self.layers(*features))
        return torch.clamp(raw, -1.0, 1.0) if self._clip else torch.tanh(raw)


def _picture_layers(shape: tuple[int, ...]) -> nn.Sequential:
    """(batch, *shape) -> (batch, PICTURE_FEATURES)."""
    channels, rows, columns = shape
    layers = nn.Sequential(
        nn.Conv2d(channels, 16, 3, stride=2, padding=1), nn.ReLU(),
        nn.Conv2d(16, 32, 3, stride=2, padding=1), nn.ReLU(),
        nn.Flatten(),
    )  # fmt: skip
    with torch.no_grad():
        size = layers(torch.zeros(1, channels, rows, columns)).shape[1]
    return nn.Sequential(layers, nn.Linear(size, PICTURE_FEATURES), nn.ReLU())


class ExportError(RuntimeError):
    """The file would be too large, or its actions would differ from the network's."""


def export(network: PolicyNetwork, spec: PolicySpec, shapes: Shapes, path: Path) -> float:
    """Writes the file and returns the maximum difference of its actions from the network's for random features. Raises
    ExportError if that exceeds 1e-5 or the file exceeds MAX_BYTES."""
    max_action_difference = 1e-5  # between torch and ONNX [-]
    opset = 17
    network.eval()
    random = torch.Generator().manual_seed(0)
    examples = [torch.randn((EXAMPLES, *shapes[key]), generator=random) for key in network.keys]
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of torch's older exporter, which needs no extra package
        torch.onnx.export(
            network,
            tuple(example[:1] for example in examples),
            buffer,
            input_names=list(network.keys),
            output_names=["action"],
            opset_version=opset,
            dynamo=False,
        )
    model = onnx.load_model_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {METADATA_KEY: spec.model_dump_json()})
    data = model.SerializeToString()
    if len(data) > MAX_BYTES:
        raise ExportError(f"the policy has {len(data) / 2**20:.1f} MiB, the maximum is {MAX_BYTES >> 20} MiB")
    max_difference = _max_action_difference(network, data, examples)
    if not max_difference <= max_action_difference:
        raise ExportError(
            f"the file's actions differ by {max_difference:.2g} from the network's, allowed: {max_action_difference:g}"
        )
    write_whole(path, data)
    return max_difference


def _max_action_difference(network: PolicyNetwork, data: bytes, examples: list[torch.Tensor]) -> float:
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    max_difference = 0.0
    for index in range(EXAMPLES):
        one = [example[index : index + 1] for example in examples]
        with torch.no_grad():
            expected = network(*one).numpy()
        (actual,) = session.run(["action"], {key: value.numpy() for key, value in zip(network.keys, one, strict=True)})
        max_difference = max(max_difference, float(np.abs(actual - expected).max()))
    return max_difference
