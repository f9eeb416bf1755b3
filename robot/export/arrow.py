"""Columns of numbers and pictures as Arrow tables, with what tells Hugging Face's `datasets` their types."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robot.export.lerobot_mapping import Feature

if TYPE_CHECKING:
    import pyarrow as pa

LABEL = "label"  # dtype of a feature whose numbers stand for its names
Column = NDArray[Any] | Sequence[bytes]  # (rows, ...), or PNG pictures


def arrow_table(features: Mapping[str, Feature], columns: Mapping[str, Column]) -> pa.Table:
    """One row group's worth of rows, in the order of `features`."""
    import pyarrow as pa

    arrays = [_array(feature, columns[name]) for name, feature in features.items()]
    told = {"info": {"features": {name: _told(feature) for name, feature in features.items()}}}
    schema = pa.schema(
        [pa.field(name, array.type) for name, array in zip(features, arrays, strict=True)],
        metadata={"huggingface": json.dumps(told)},
    )
    return pa.Table.from_arrays(arrays, schema=schema)


def _array(feature: Feature, column: Column) -> pa.Array:
    import pyarrow as pa

    if feature.dtype == "image":
        data = pa.array(column, pa.binary())
        return pa.StructArray.from_arrays([data, pa.nulls(len(data), pa.string())], ["bytes", "path"])
    numbers = np.ascontiguousarray(column)
    array = pa.array(numbers.ravel())
    if feature.shape == (1,):
        return array
    if len(feature.shape) == 1:
        return pa.FixedSizeListArray.from_arrays(array, feature.shape[0])
    for side in reversed(feature.shape):  # `datasets` keeps maps as lists of lists
        array = pa.ListArray.from_arrays(np.arange(0, len(array) + 1, side, dtype=np.int32), array)
    return array


def _told(feature: Feature) -> dict[str, Any]:
    """The feature in the words of `datasets`."""
    if feature.dtype == "image":
        return {"_type": "Image"}
    if feature.dtype == LABEL:
        return {"names": list(feature.names or ()), "_type": "ClassLabel"}
    number = {"dtype": feature.dtype, "_type": "Value"}
    if feature.shape == (1,):
        return number
    if len(feature.shape) == 1:
        return {"feature": number, "length": feature.shape[0], "_type": "List"}
    return {"shape": list(feature.shape), "dtype": feature.dtype, "_type": f"Array{len(feature.shape)}D"}
