"""What was identified, as files: a material, a scene, numbers, and a picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.axes import Axes

from calibration.materials.fit import Parameter
from calibration.materials.presses import Press
from robot.common.whole_file import whole_folder
from robot.studies.identify.identify import Identified
from robot.studies.identify.motions import MOTIONS_FOR_PARAMETER
from tacsim.interface import FloatArray
from tacsim.models.text import printable_line
from tacsim.report.figure import COLOURS, INK, QUIET, canvas, plain, save

UNITS = {"youngs_modulus": ("kPa", 1e-3), "yield_stress": ("kPa", 1e-3), "hardening_modulus": ("kPa", 1e-3)}
FORMAT = 1


def format_value(parameter: Parameter, value: float) -> str:
    """The value with its unit, for a person."""
    unit, scale = UNITS.get(parameter.name, ("", 1.0))
    return f"{value * scale:.4g} {unit}".strip()


def describe_parameters(identified: Identified) -> list[tuple[str, str, str]]:
    """Name, value and 95 % interval of each parameter, for a person."""
    rows = []
    for each in identified.fit.identified:
        low, high = identified.fit.interval(each.name)
        rows.append((
            each.name, format_value(each, identified.fit.value(each.name)),
            f"{format_value(each, low)} to {format_value(each, high)}",
        ))  # fmt: skip
    return rows


def material(identified: Identified) -> dict[str, Any]:
    """The material as its file says it, without what is as usual."""
    scene = identified.scene
    model = scene.gel.material if identified.kind == "gel" else scene.body.material  # type: ignore[union-attr]
    return {key: value for key, value in model.model_dump(mode="json").items() if value is not None and key != "source"}


def write(folder: Path, identified: Identified) -> list[Path]:
    """Writes identified.json and identified.png, and if nothing speaks against the fit, material.yaml and scene.yaml,
    all at once: `folder`, which must not be there, comes with all of them or not at all. Raises OSError."""
    with whole_folder(folder) as made:
        text = json.dumps(as_json(identified), indent=1, allow_nan=False)
        (made / "identified.json").write_text(text + "\n", encoding="utf-8")
        draw(identified, describe_parameters(identified), made / "identified.png")
        if not identified.findings:
            (made / "material.yaml").write_text(_material_text(identified), encoding="utf-8")
            (made / "scene.yaml").write_text(_scene_text(identified), encoding="utf-8")
    return sorted(folder.iterdir())


def as_json(identified: Identified) -> dict[str, Any]:
    """Everything in SI units."""
    fit = identified.fit
    return {
        "format": FORMAT,
        "kind": identified.kind,
        "trusted": not identified.findings,
        "parameters": {
            each.name: {
                "value": fit.value(each.name),
                "low": fit.interval(each.name)[0],
                "high": fit.interval(each.name)[1],
                "moved_by_mesh": float(fit.mesh_shift[index]),
            }
            for index, each in enumerate(fit.parameters)
            if each in fit.identified
        },
        "untold": {each.name: MOTIONS_FOR_PARAMETER[identified.kind][each.name] for each in fit.unidentified},
        "findings": [{"kind": each.kind, "words": each.text} for each in identified.findings],
        "noise": {"force": identified.noise.force, "dent": identified.noise.dent, "slip": identified.noise.slip},
        "presses": [press.name for press in identified.presses],
        "simulated": fit.runs,
        "size_error": identified.size_error,
        "scatter": float(np.sqrt(np.mean(((identified.signals.values - fit.predicted) / fit.sigma) ** 2))),
    }


def _origin(identified: Identified) -> str:
    names = [printable_line(press.name) for press in identified.presses]
    what = "presses" if identified.kind == "gel" else "squeezes"
    held = ", ".join(each.name for each in identified.fit.unidentified)
    kept = f" Not told by them, as it was before: {held}." if held else ""
    return (
        f"Identified {date.today().isoformat()} from {len(names)} {what} ({', '.join(names[:6])}"
        f"{' ...' if len(names) > 6 else ''}), force noise {identified.noise.force:g} N.{kept}"
    )


def _material_text(identified: Identified) -> str:
    """A material file, the intervals beside the numbers."""
    fit, lines = identified.fit, [f"# A {identified.kind}, identified. Beside a number: its 95 % interval."]
    found = {each.name for each in fit.identified}
    for key, value in material(identified).items():
        note = ""
        if key in found:
            low, high = fit.interval(key)
            note = f" # {low:.6g} to {high:.6g}"
        elif key in {each.name for each in fit.unidentified}:
            note = " # not told by the recordings: as it was"
        lines.append(f"{key}: {json.dumps(float(f'{value:.6g}') if isinstance(value, float) else value)}{note}")
    lines.append(yaml.safe_dump({"source": _origin(identified)}, width=110, allow_unicode=True).rstrip())
    return "\n".join(lines) + "\n"


def _scene_text(identified: Identified) -> str:
    head = f"# {_origin(identified)} The materials and frictions found, in the scene that was simulated.\n"
    content = identified.scene.model_dump(mode="json")
    return head + yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110)


def draw(identified: Identified, table: Sequence[tuple[str, str, str]], path: Path) -> None:
    """Writes a picture: for each press its normal force against depth, its sideways force against the way sideways, and
    what is left of all signals over its standard deviation; on top what was found."""
    max_drawn = 6  # presses; a column each
    drawn = identified.presses[:max_drawn]
    figure = canvas(max(3.4 * len(drawn), 9.0), 9.5)
    lines = [f"{name.replace('_', ' ')}   {value}   (95 %: {interval})" for name, value, interval in table]
    lines += [f"{each.name.replace('_', ' ')}   not told" for each in identified.fit.unidentified]
    lines += [f"NOT TO BE USED: {each.text}"[:150] for each in identified.findings]
    left = len(identified.presses) - len(drawn)
    lines += [f"and {left} more presses"] if left else []
    # no suptitle, for which tight_layout would leave room once more
    figure.text(0.02, 0.99, "\n".join(line.replace("$", r"\$") for line in lines), va="top", fontsize=9, color=INK)
    for column, press in enumerate(drawn):
        rows = [figure.add_subplot(3, len(drawn), column + 1 + k * len(drawn)) for k in range(3)]
        depth, sideways = _depth(press), _sideways(press)
        _forces(identified, column, rows[0], depth, ("fz",), "depth [mm]", press.name)
        _forces(identified, column, rows[1], sideways, ("fx", "fy"), "sideways [mm]", "")
        _residuals(identified, column, rows[2])
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.99 - 0.016 * (len(lines) + 1)))
    save(figure, path)


def _depth(press: Press) -> FloatArray:
    """How far the parts are closed, from where they were farthest [mm]."""
    if "indenter" in press.poses:
        height = np.array([pose.position[2] for pose in press.poses["indenter"]])
    else:
        height = np.array([
            upper.position[2] - lower.position[2]
            for upper, lower in zip(press.poses["upper"], press.poses["lower"], strict=True)
        ])  # fmt: skip
    found: FloatArray = (height.max() - height) * 1e3
    return found


def _sideways(press: Press) -> FloatArray:
    """How far the parts have gone sideways [mm]."""
    part = "indenter" if "indenter" in press.poses else "upper"
    places = np.array([pose.position[:2] for pose in press.poses[part]])
    found: FloatArray = ((places - places[0]) @ _direction(places)) * 1e3
    return found


def _direction(places: FloatArray) -> FloatArray:
    """The direction in which they go farthest (2,)."""
    farthest = places[np.argmax(np.linalg.norm(places - places[0], axis=1))] - places[0]
    length = float(np.linalg.norm(farthest))
    return farthest / length if length > 0 else np.array([1.0, 0.0])


def _forces(
    identified: Identified, press: int, axes: Axes, along: FloatArray, names: Sequence[str], label: str, title: str
) -> None:
    signals, fit = identified.signals, identified.fit
    plain(axes, title.replace("$", r"\$")[:32], label, "force [N]")
    count = 0
    for index, channel in enumerate(signals.channels):
        rows = (signals.press == press) & (signals.channel == index)
        if channel.partition(".")[2] not in names or not rows.any():
            continue
        values = identified.presses[press].readings[channel]
        x, colour = along[np.isfinite(values)], COLOURS[count % len(COLOURS)]
        noise = signals.noise[rows]
        axes.errorbar(x, signals.values[rows], noise, fmt="o", markersize=3, linewidth=0.8, color=colour, label=channel)
        axes.plot(x, fit.predicted[rows], color=colour, linewidth=1.0)
        count += 1
    if count:
        axes.legend(fontsize=7, frameon=False)


def _residuals(identified: Identified, press: int, axes: Axes) -> None:
    signals, fit = identified.signals, identified.fit
    plain(axes, "", "moment", "measured - fitted [sd]")
    axes.axhspan(-2, 2, color=QUIET, alpha=0.12, linewidth=0)
    for index, channel in enumerate(signals.channels):
        rows = (signals.press == press) & (signals.channel == index)
        if rows.any():
            left = (signals.values[rows] - fit.predicted[rows]) / fit.sigma[rows]
            again, number = divmod(index, len(COLOURS))  # there are more channels than colours
            style = ("o-", "s--", "^:")[again % 3]
            axes.plot(left, style, markersize=2.5, linewidth=0.7, color=COLOURS[number], label=channel)
    axes.legend(fontsize=6, frameon=False, ncols=2)
