"""What was identified, as files: a material, a scene, numbers, and a picture."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from calibration.materials.parameters import Parameter
from robot.common.whole_file import whole_folder
from robot.studies.identify.identify import Identified
from robot.studies.identify.motions import WHAT_TELLS
from robot.studies.identify.picture import draw
from tacsim.models.text import printable

UNITS = {"youngs_modulus": ("kPa", 1e-3), "yield_stress": ("kPa", 1e-3), "hardening_modulus": ("kPa", 1e-3)}
FORMAT = 1


def in_words(parameter: Parameter, value: float) -> str:
    """The value with its unit, for a person."""
    unit, scale = UNITS.get(parameter.name, ("", 1.0))
    return f"{value * scale:.4g} {unit}".strip()


def told(identified: Identified) -> list[tuple[str, str, str]]:
    """Name, value and 95 % interval of each parameter, for a person."""
    rows = []
    for each in identified.fit.identified:
        low, high = identified.fit.interval(each.name)
        rows.append((
            each.name, in_words(each, identified.fit.value(each.name)),
            f"{in_words(each, low)} to {in_words(each, high)}",
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
        draw(identified, told(identified), made / "identified.png")
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
        "untold": {each.name: WHAT_TELLS[identified.kind][each.name] for each in fit.unidentified},
        "findings": [{"kind": each.kind, "words": each.text} for each in identified.findings],
        "noise": {"force": identified.noise.force, "dent": identified.noise.dent, "slip": identified.noise.slip},
        "presses": [press.name for press in identified.presses],
        "simulated": fit.runs,
        "size_error": identified.size_error,
        "scatter": float(np.sqrt(np.mean(((identified.signals.values - fit.predicted) / fit.sigma) ** 2))),
    }


def _origin(identified: Identified) -> str:
    names = [printable(press.name) for press in identified.presses]
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
