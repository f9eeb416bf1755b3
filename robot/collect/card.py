"""The data card of a set, README.md: its contents, their units, and how it was made. `datasets` reads its head."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from robot.collect.folder import FAILURES, SetFolder
from robot.collect.presses import COLUMN_TEXTS, PressSet
from robot.collect.workers import SetError
from robot.studies.press import MAX_MISSED_DEPTH_SHARE
from tacsim.models.scene import Mesh, Shape
from tacsim.models.text import millimetres, printable_line

QUANTITIES = {"depth": (1e3, "mm"), "normal_force": (1.0, "N"), "shear": (1e3, "mm"), "shear_force": (1.0, "N"),
              "contact_area": (1e6, "mm²")}  # fmt: skip


def press_card(settings: PressSet, command: str, versions: Mapping[str, str], statistics: str = "") -> str:
    """The card as Markdown. statistics: the result of `press_statistics` for a complete set."""
    geometry, lattice, scene = settings.sensor.geometry, settings.lattice, settings.scene
    material, sensor_name = scene.gel.material, _escape_cell(settings.sensor.name)
    columns = "\n".join(
        f"| `{name}` | {_describe_feature(each)} | {COLUMN_TEXTS[name]} |" for name, each in settings.columns.items()
    )
    objects = "\n".join(
        f"| `{_escape_cell(name)}` | {_describe_object(each)} |" for name, each in settings.objects.items()
    )
    (u0, v0), pitch = geometry.principal, 1e3 * geometry.pixel_pitch
    dots = ", where the sensor's dots are printed," if settings.sensor.markers else ""
    made_with = ", ".join(f"{name} {number}" for name, number in versions.items())
    x, y, thickness = (1e3 * side for side in scene.gel.size)
    pose = (
        "anywhere in the picture, with any rotation about the vertical" if settings.pose == "random" else "the middle"
    )
    ranges = [f"depth {_format_range(settings.depth, 1e3, 'mm')}", f"pose {pose}"]
    ranges += [
        f"{name} {_format_range(getattr(settings, name), scale, unit)}"
        for name, scale, unit in (("tilt", 180 / math.pi, "°"), ("shear", 1e3, "mm"), ("twist", 180 / math.pi, "°"))
        if any(getattr(settings, name))
    ]
    return f"""---
configs:
- config_name: default
  data_files:
  - split: train
    path: data/train-*.parquet
tags:
- tactile
- simulation
---

# Presses of {len(settings.objects)} objects on a gel

Simulated by tacsim. Each row is one press: the sensor's picture, and the ground truth of the simulation.

```python
from datasets import load_dataset

presses = load_dataset("FOLDER", split="train").with_format("numpy")
```

| column | type | what |
|---|---|---|
{columns}

Frame: the middle of the gel's rest surface; x along image columns (right), y along image rows (down), z out of the gel
towards the object. Pixel (u, v) is centred at x = (u - {u0:g}) p, y = (v - {v0:g}) p with p = {pitch:g} mm. `flow` is
given at {lattice.rows} x {lattice.columns} points (rows along y) {lattice.pitch * 1e3:g} mm apart{dots} round the
sensor's axis. `reference.png` is the picture of the untouched gel, without the camera's noise.

Sensor: {sensor_name}, {geometry.width} x {geometry.height} px. {_escape_cell(settings.sensor.source)}

Gel: {x:g} x {y:g} x {thickness:g} mm, Young's modulus {material.youngs_modulus * 1e-3:g} kPa, Poisson's ratio
{material.poisson_ratio:g}; friction {scene.indenter.friction if scene.indenter else 0:g}; elements of
{scene.effective_element_size * 1e3:g} mm (preset {scene.preset}). Edges of boxes and cylinders are rounded by
{scene.effective_element_size * 500:g} mm or a quarter of their shortest side, unless `collect.json` says otherwise.

Drawn evenly by seed {settings.seed}: {"; ".join(ranges)}.
Press i uses object i mod {len(settings.objects)}; it depends on the seed and i alone.

| object | geometry |
|---|---|
{objects}

Made by

```bash
{command}
```

with {made_with}.
All settings are in `collect.json`. `{FAILURES}` lists failed presses with their reasons; it is absent if
none failed.
{statistics}"""


def press_statistics(folder: SetFolder, settings: PressSet) -> str:
    """Statistics of all rows, and by object, as Markdown. Raises SetError for a file that cannot be read."""
    import pyarrow as pa
    from pyarrow import parquet

    names = ["object", "depth", "normal_force", "shear", "shear_force", "contact_area", "unfelt", "folded", "settled"]
    columns: dict[str, list[Any]] = {name: [] for name in names}
    for path in folder.files:
        try:
            table = parquet.read_table(path, columns=names)
        except (pa.ArrowInvalid, OSError):
            raise SetError(f"{path} is damaged; delete it, then repeat the same command to make it again") from None
        for name, values in table.to_pydict().items():
            columns[name] += values
    of = {name: np.array(values) for name, values in columns.items()}
    if not len(of["object"]):
        return ""
    for name in ("shear", "shear_force"):
        of[name] = np.linalg.norm(of[name], axis=1)
    listed = [name for name in QUANTITIES if name in of and (name != "shear" or any(settings.shear))]
    head = [f"{name} [{QUANTITIES[name][1]}]" for name in listed]
    lines = [
        f"\n## Statistics\n\n{len(of['object'])} presses, {len(folder.failures)} failed, "
        f"{int((~of['settled']).sum())} not settled, "
        f"{int((of['unfelt'] > MAX_MISSED_DEPTH_SHARE).sum())} with forces too small "
        f"(`unfelt` above {MAX_MISSED_DEPTH_SHARE:g}), {int(of['folded'].sum())} folded.\n",
        _table_row(["", "presses", *head]),
        _table_row(["---"] * (2 + len(head))),
    ]
    for number, name in [(None, "all"), *enumerate(settings.objects)]:
        mine = slice(None) if number is None else of["object"] == number
        cells = [_format_quantiles(QUANTITIES[each][0] * of[each][mine]) for each in listed]
        lines.append(_table_row([_escape_cell(name), str(len(of["object"][mine])), *cells]))
    return "\n".join([*lines, "\nEach cell: 5 % quantile, median, 95 % quantile.\n"])


def _table_row(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _format_quantiles(values: Any) -> str:
    return "–" if not len(values) else ", ".join(f"{each:.3g}" for each in np.quantile(values, [0.05, 0.5, 0.95]))


def _describe_feature(feature: Any) -> str:
    if feature.dtype == "image":
        return f"PNG, {feature.shape[1]} x {feature.shape[0]}"
    shape = "" if feature.shape == (1,) else f" {feature.shape if len(feature.shape) > 1 else f'({feature.shape[0]},)'}"
    return f"{'class' if feature.dtype == 'label' else feature.dtype}{shape}"


def _describe_object(geometry: Shape) -> str:
    if isinstance(geometry, Mesh):
        unit = "unit guessed from its size" if geometry.scale is None else f"{geometry.scale:g} m per unit"
        return f"`{_escape_cell(geometry.path)}`, {unit}"
    sizes = geometry.model_dump(mode="json")
    shape = sizes.pop("shape")
    return ", ".join(
        [shape, *(f"{key} {millimetres(*np.atleast_1d(side), digits='g')}" for key, side in sizes.items())]
    )


def _format_range(between: tuple[float, float], scale: float, unit: str) -> str:
    low, high = (f"{scale * each:.4g}" for each in between)
    return f"{low} {unit}" if low == high else f"{low} to {high} {unit}"


def _escape_cell(text: str) -> str:
    return printable_line(text).replace("|", "\\|").replace("`", "'")
