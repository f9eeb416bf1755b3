"""A trained network as a policy file: ONNX with everything inside, that says of itself what it sees."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray

from robot.train.network import PolicyNetwork
from tacsim.models.policy import METADATA_KEY, PolicySpec

OPSET = 17
MOST_BYTES = 2 * 2**20
PARITY = 1e-5  # between torch and ONNX


class ExportError(RuntimeError):
    """The file would not do what the network does."""


def export(network: PolicyNetwork, spec: PolicySpec, examples: Mapping[str, NDArray[Any]], path: Path) -> float:
    """Writes the file, and returns the greatest difference of its actions from the network's, over the examples (batch,
    ...). Raises ExportError when that is more than PARITY, or the file has more than MOST_BYTES."""
    network.eval()
    inputs = tuple(torch.from_numpy(np.asarray(examples[key][:1], np.float32)) for key in network.keys)
    buffer = io.BytesIO()
    torch.onnx.export(
        network, inputs, buffer, input_names=list(network.keys), output_names=["action"], opset_version=OPSET,
        dynamo=False,
    )  # fmt: skip
    model = onnx.load_model_from_string(buffer.getvalue())
    onnx.helper.set_model_props(model, {METADATA_KEY: spec.model_dump_json()})
    data = model.SerializeToString()
    if len(data) > MOST_BYTES:
        raise ExportError(f"the policy has {len(data) / 2**20:.1f} MiB, at most {MOST_BYTES >> 20} are written")
    worst = _difference(network, data, examples)
    if not worst <= PARITY:
        raise ExportError(f"the file's actions differ by {worst:.2g} from the network's, allowed: {PARITY:g}")
    part = path.with_suffix(".part")
    part.write_bytes(data)
    part.replace(path)  # there is a whole file or none
    return worst


def _difference(network: PolicyNetwork, data: bytes, examples: Mapping[str, NDArray[Any]]) -> float:
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    worst = 0.0
    for index in range(len(examples[network.keys[0]])):
        one = {key: np.asarray(examples[key][index : index + 1], np.float32) for key in network.keys}
        with torch.no_grad():
            wanted = network(*(torch.from_numpy(one[key]) for key in network.keys)).numpy()
        worst = max(worst, float(np.abs(session.run(["action"], one)[0] - wanted).max()))
    return worst
