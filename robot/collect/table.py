"""The columns of a press set, and its Parquet files, which `datasets`, pandas, DuckDB and others read."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robot.export.lerobot_mapping import LABEL, Column, Feature, arrow_table
from tacsim.models.sensor import Markers, SensorGeometry

Row = dict[str, Any]

# description of each column in the data card
COLUMN_TEXTS = {
    "index": "number of the press; with the seed it determines all random numbers",
    "object": "the object that was pressed",
    "image": "the sensor's picture, RGB",
    "height": "[m] of the gel's surface under each pixel: into the gel is positive, bulges are negative",
    "contact": "255 where the object touches the gel, 0 elsewhere, for each pixel",
    "flow": "[m] along x and y (image columns and rows) that points on the gel have moved, on an even lattice",
    "normal_force": "[N] on the gel, pressing is positive",
    "shear_force": "[N] on the gel along x and y",
    "torque": "[N m] on the gel about the middle of its rest surface, axes x, y, z (z is out of the gel)",
    "depth": "[m] of the object's lowest point below the undeformed surface",
    "shear": "[m] tangential displacement of the object along x and y, after the press",
    "twist": "[rad] rotation of the object about z, after the shear",
    "position": "[m] of the middle of the object's bounding box in the sensor's frame, at the end",
    "quaternion": "(x, y, z, w) of the object in that frame, at the end",
    "contact_area": "[m^2] of `contact`",
    "unfelt": "share of the depth that no contact point of the gel reaches; above 0.125 a tip or edge is too narrow "
    "for the mesh, and the forces are too small",
    "folded": "whether the gel folds over itself; picture and height show the sheet that the camera sees",
    "settled": "whether all motions came to rest within the scene's tolerance",
}


def press_columns(objects: Sequence[str], geometry: SensorGeometry, lattice: Markers) -> dict[str, Feature]:
    """Type and shape of each column, by name. objects: their names. lattice: the points at which flow is given."""
    shape = (geometry.height, geometry.width)
    number, pair, triple = (Feature("float64", (n,), None) for n in (1, 2, 3))
    return {
        "index": Feature("int64", (1,), None),
        "object": Feature(LABEL, (1,), tuple(objects)),
        "image": Feature("image", (*shape, 3), None),
        "height": Feature("float32", shape, None),
        "contact": Feature("image", shape, None),
        "flow": Feature("float32", (lattice.rows, lattice.columns, 2), None),
        "normal_force": number,
        "shear_force": pair,
        "torque": triple,
        "depth": number,
        "shear": pair,
        "twist": number,
        "position": triple,
        "quaternion": Feature("float64", (4,), None),
        "contact_area": number,
        "unfelt": number,
        "folded": Feature("bool", (1,), None),
        "settled": Feature("bool", (1,), None),
    }


def parquet_bytes(columns: Mapping[str, Feature], rows: Sequence[Row]) -> bytes:
    """A Parquet file with these rows. Numbers keep their precision and pictures are PNG, so the file is lossless."""
    rows_in_group = 25  # a reader of one row reads its whole group, about 10 MB
    from pyarrow import parquet

    values = {name: _column(feature, [row[name] for row in rows]) for name, feature in columns.items()}
    table = arrow_table(columns, values)
    maps = [f"{name}{'.list.element' * len(columns[name].shape)}" for name in ("height", "flow")]
    buffer = io.BytesIO()
    parquet.write_table(
        table,
        buffer,
        row_group_size=rows_in_group,
        compression="zstd",
        use_dictionary=False,  # measured numbers do not repeat
        column_encoding=dict.fromkeys(maps, "BYTE_STREAM_SPLIT"),  # groups bytes of equal significance: a third smaller
    )
    return buffer.getvalue()


def _column(feature: Feature, values: Sequence[Any]) -> Column:
    if feature.dtype == "image":
        return values
    dtype = "int64" if feature.dtype == LABEL else feature.dtype
    shape = () if feature.shape == (1,) else feature.shape
    return np.array(values, dtype).reshape(len(values), *shape)
