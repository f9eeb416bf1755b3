"""The identified material as files: a material, a scene, numbers, and a picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.axes import Axes

from calibration.materials.fit import Parameter, Press
from robot.common.whole_file import whole_folder
from robot.studies.identify.identify import Identified
from robot.studies.identify.motions import MOTIONS_FOR_PARAMETER
from tacsim.interface import FloatArray
from tacsim.models.text import printable_line
from tacsim.report.figure import COLOURS, INK, MUTED, new_figure, save_figure, style_axes

UNITS = {"youngs_modulus": ("kPa", 1e-3), "yield_stress": ("kPa", 1e-3), "hardening_modulus": ("kPa", 1e-3)}
FORMAT = 1


def format_value(parameter: Parameter, value: float) -> str:
    """The value with its unit, as text."""
    unit, scale = UNITS.get(parameter.name, ("", 1.0))
    return f"{value * scale:.4g} {unit}".strip()


def describe_parameters(identified: Identified) -> list[tuple[str, str, str]]:
    """Name, value and 95 % interval of each parameter, as text."""
    rows = []
    for each in identified.fit.identified:
        low, high = identified.fit.interval(each.name)
        rows.append((
            each.name, format_value(each, identified.fit.value(each.name)),
            f"{format_value(each, low)} to {format_value(each, high)}",
        ))  # fmt: skip
    return rows


def material(identified: Identified) -> dict[str, Any]:
    """The content of the material file, without empty fields."""
    scene = identified.scene
    model = scene.gel.material if identified.kind == "gel" else scene.body.material  # type: ignore[union-attr]
    return {key: value for key, value in model.model_dump(mode="json").items() if value is not None and key != "source"}


def write(folder: Path, identified: Identified) -> list[Path]:
    """Writes identified.json and identified.png into a new `folder`, and without findings also material.yaml and
    scene.yaml. The folder appears complete or not at all. Raises OSError."""
    with whole_folder(folder) as made:
        text = json.dumps(as_json(identified), indent=1, allow_nan=False)
        (made / "identified.json").write_text(text + "\n", encoding="utf-8")
        draw(identified, describe_parameters(identified), made / "identified.png")
        if not identified.findings:
            (made / "material.yaml").write_text(_material_text(identified), encoding="utf-8")
            (made / "scene.yaml").write_text(_scene_text(identified), encoding="utf-8")
    return sorted(folder.iterdir())


def as_json(identified: Identified) -> dict[str, Any]:
    """The result in SI units."""
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
        "unidentified": {each.name: MOTIONS_FOR_PARAMETER[identified.kind][each.name] for each in fit.unidentified},
        "findings": [{"kind": each.kind, "words": each.text} for each in identified.findings],
        "noise": {"force": identified.noise.force, "dent": identified.noise.dent, "slip": identified.noise.slip},
        "presses": [press.name for press in identified.presses],
        "simulated": fit.runs,
        "size_error": identified.size_error,
        "scatter": float(np.sqrt(np.mean(((identified.signals.values - fit.predicted) / fit.sigma) ** 2))),
    }


def _origin(identified: Identified) -> str:
    names = [printable_line(press.name) for press in identified.presses]
    kinds = "presses" if identified.kind == "gel" else "squeezes"
    held = ", ".join(each.name for each in identified.fit.unidentified)
    unchanged = f" Not identified by them, and unchanged: {held}." if held else ""
    return (
        f"Identified {date.today().isoformat()} from {len(names)} {kinds} ({', '.join(names[:6])}"
        f"{' ...' if len(names) > 6 else ''}), force noise {identified.noise.force:g} N.{unchanged}"
    )


def _material_text(identified: Identified) -> str:
    """The text of a material file, with the interval next to each number."""
    fit, lines = identified.fit, [f"# An identified {identified.kind}. Next to a number: its 95 % interval."]
    found = {each.name for each in fit.identified}
    for key, value in material(identified).items():
        note = ""
        if key in found:
            low, high = fit.interval(key)
            note = f" # {low:.6g} to {high:.6g}"
        elif key in {each.name for each in fit.unidentified}:
            note = " # not identified by the recordings: unchanged"
        lines.append(f"{key}: {json.dumps(float(f'{value:.6g}') if isinstance(value, float) else value)}{note}")
    lines.append(yaml.safe_dump({"source": _origin(identified)}, width=110, allow_unicode=True).rstrip())
    return "\n".join(lines) + "\n"


def _scene_text(identified: Identified) -> str:
    head = f"# {_origin(identified)} The simulated scene with the identified materials and frictions.\n"
    content = identified.scene.model_dump(mode="json")
    return head + yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110)


def draw(identified: Identified, table: Sequence[tuple[str, str, str]], path: Path) -> None:
    """Writes a picture: for each press its normal force against depth, its tangential force against the tangential
    displacement, and the residuals of all signals divided by their standard deviation; the results are on top."""
    max_drawn = 6  # presses, one column each
    drawn = identified.presses[:max_drawn]
    figure = new_figure(max(3.4 * len(drawn), 9.0), 9.5)
    lines = [f"{name.replace('_', ' ')}   {value}   (95 %: {interval})" for name, value, interval in table]
    lines += [f"{each.name.replace('_', ' ')}   not identified" for each in identified.fit.unidentified]
    lines += [f"DO NOT USE: {each.text}"[:150] for each in identified.findings]
    left = len(identified.presses) - len(drawn)
    lines += [f"and {left} more presses"] if left else []
    # not a suptitle: tight_layout would reserve space for it a second time
    figure.text(0.02, 0.99, "\n".join(line.replace("$", r"\$") for line in lines), va="top", fontsize=9, color=INK)
    for column, press in enumerate(drawn):
        rows = [figure.add_subplot(3, len(drawn), column + 1 + k * len(drawn)) for k in range(3)]
        depth, sideways = _depth(press), _sideways(press)
        _forces(identified, column, rows[0], depth, ("fz",), "depth [mm]", press.name)
        _forces(identified, column, rows[1], sideways, ("fx", "fy"), "sideways [mm]", "")
        _residuals(identified, column, rows[2])
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.99 - 0.016 * (len(lines) + 1)))
    save_figure(figure, path)


def _depth(press: Press) -> FloatArray:
    """Displacement of the parts towards each other, from their largest distance [mm]."""
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
    """Tangential displacement of the parts [mm]."""
    part = "indenter" if "indenter" in press.poses else "upper"
    places = np.array([pose.position[:2] for pose in press.poses[part]])
    found: FloatArray = ((places - places[0]) @ _direction(places)) * 1e3
    return found


def _direction(places: FloatArray) -> FloatArray:
    """The direction of the largest displacement (2,)."""
    farthest = places[np.argmax(np.linalg.norm(places - places[0], axis=1))] - places[0]
    length = float(np.linalg.norm(farthest))
    return farthest / length if length > 0 else np.array([1.0, 0.0])


def _forces(
    identified: Identified, press: int, axes: Axes, along: FloatArray, names: Sequence[str], label: str, title: str
) -> None:
    signals, fit = identified.signals, identified.fit
    style_axes(axes, title.replace("$", r"\$")[:32], label, "force [N]")
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
    style_axes(axes, "", "moment", "measured - fitted [sd]")
    axes.axhspan(-2, 2, color=MUTED, alpha=0.12, linewidth=0)
    for index, channel in enumerate(signals.channels):
        rows = (signals.press == press) & (signals.channel == index)
        if rows.any():
            residual = (signals.values[rows] - fit.predicted[rows]) / fit.sigma[rows]
            repeat, number = divmod(index, len(COLOURS))  # there are more channels than colours
            style = ("o-", "s--", "^:")[repeat % 3]
            axes.plot(residual, style, markersize=2.5, linewidth=0.7, color=COLOURS[number], label=channel)
    axes.legend(fontsize=6, frameon=False, ncols=2)
