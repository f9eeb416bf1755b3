"""A trained network as a policy file: ONNX with everything inside, that says of itself what it sees."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

from robot.common.whole_file import write_whole
from robot.train.network import PolicyNetwork, Shapes
from tacsim.models.policy import METADATA_KEY, PolicySpec

OPSET = 17
MOST_BYTES = 2 * 2**20
PARITY = 1e-5  # between torch and ONNX
EXAMPLES = 64


class ExportError(RuntimeError):
    """The file would not do what the network does."""


def export(network: PolicyNetwork, spec: PolicySpec, shapes: Shapes, path: Path) -> float:
    """Writes the file, and returns the greatest difference of its actions from the network's, for random features.
    Raises ExportError when that is more than PARITY, or the file has more than MOST_BYTES."""
    network.eval()
    random = torch.Generator().manual_seed(0)
    examples = [torch.randn((EXAMPLES, *shapes[key]), generator=random) for key in network.keys]
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore", DeprecationWarning
        )  # of torch's older exporter, whose graphs need no extra package
        torch.onnx.export(
            network,
            tuple(example[:1] for example in examples),
            buffer,
            input_names=list(network.keys),
            output_names=["action"],
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load_model_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {METADATA_KEY: spec.model_dump_json()})
    data = model.SerializeToString()
    if len(data) > MOST_BYTES:
        raise ExportError(f"the policy has {len(data) / 2**20:.1f} MiB, at most {MOST_BYTES >> 20} are written")
    worst = _difference(network, data, examples)
    if not worst <= PARITY:
        raise ExportError(f"the file's actions differ by {worst:.2g} from the network's, allowed: {PARITY:g}")
    write_whole(path, data)
    return worst


def _difference(network: PolicyNetwork, data: bytes, examples: list[torch.Tensor]) -> float:
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    worst = 0.0
    for index in range(EXAMPLES):
        one = [example[index : index + 1] for example in examples]
        with torch.no_grad():
            wanted = network(*one).numpy()
        (found,) = session.run(["action"], {key: value.numpy() for key, value in zip(network.keys, one, strict=True)})
        worst = max(worst, float(np.abs(found - wanted).max()))
    return worst
