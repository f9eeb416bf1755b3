"""The page of a press: the picture, the height in 3-D, and the force over the depth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tacsim.interface import Float32
from tacsim.report.report import data_url, render_page, script_hash, script_text, to_script_json

MAX_POINTS = 72  # of the surface in 3-D, along its longer side
CURVE = (420, 300, 64)  # width, height and margin of the force curve [px]


def write_press_page(
    path: Path, folder: Path, height: Float32, config: Mapping[str, Any], curve: Sequence[tuple[float, float]]
) -> None:
    """Writes one HTML file, with the pictures of `folder` in it, that needs no other file and no network.

    height: (H, W) into the gel [m]; config: that of press.json; curve: depth [m] and normal force [N] of points of the
    press. Raises OSError.
    """
    script = Path(__file__).with_name("press.js").read_text(encoding="utf-8")
    page = render_page(
        Path(__file__).with_name("press.html.jinja"),
        title=f"press: {config['pressing_side']}",
        picture=data_url((folder / "rgb.png").read_bytes()),
        sections=data_url((folder / "side.png").read_bytes()),
        rows=_rows(config),
        curve=_curve(curve),
        surface=to_script_json(_surface(height, config["pixel_pitch"])),
        script=script_text(script),
        script_hash=script_hash(script),
    )
    path.write_text(page, encoding="utf-8")


def _rows(config: Mapping[str, Any]) -> list[tuple[str, str]]:
    slide = " ".join(f"{1e3 * value:g}" for value in config["slide"])
    rows = [
        ("normal force", f"{config['force']:.4f} N"),
        ("contact radius", f"{1e3 * config['contact_radius']:.3f} mm"),
        ("deepest", f"{1e3 * config['deepest']:.3f} mm"),
        ("depth", f"{1e3 * config['depth']:g} mm"),
        ("preset", f"{config['preset']}, elements of {1e3 * config['element_size']:g} mm"),
        ("settled", "yes" if config["settled"] else f"no: {config['unfollowed'] or 'see press.json'}"),
    ]
    if any(config["slide"]):
        rows.insert(4, ("slide", f"{slide} mm"))
    if config["twist"]:
        rows.insert(4, ("twist", f"{np.degrees(config['twist']):g} deg"))
    return rows


def _surface(height: Float32, pitch: float) -> dict[str, Any]:
    """Heights [mm] of at most MAX_POINTS x MAX_POINTS points, row by row, and their colours."""
    import cv2

    rows, columns = height.shape
    scale = min(1.0, MAX_POINTS / max(rows, columns))
    size = max(2, round(columns * scale)), max(2, round(rows * scale))
    small = np.asarray(cv2.resize(np.nan_to_num(height), size, interpolation=cv2.INTER_AREA), np.float32)
    levels = np.clip(255 * small / max(float(small.max()), 1e-9), 0, 255).astype(np.uint8)
    colours = np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1])
    return {
        "columns": size[0],
        "rows": size[1],
        "width": 1e3 * pitch * columns,
        "height": 1e3 * pitch * rows,
        "depths": [round(1e3 * float(value), 4) for value in small.ravel()],
        "colours": ["#" + bytes(colour.tolist()).hex() for colour in colours.reshape(-1, 3)],
    }


def _curve(points: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """Points of a line in an SVG, and its labels; the curve begins at no depth and no force."""
    width, height, margin = CURVE
    depths, forces = np.array([(0.0, 0.0), *points]).T
    deepest, strongest = max(float(depths.max()), 1e-9), max(float(forces.max()), 1e-9)
    x = margin + (width - 1.5 * margin) * depths / deepest
    y = height - margin - (height - 1.5 * margin) * forces / strongest
    return {
        "width": width,
        "height": height,
        "margin": margin,
        "points": [(round(float(u), 1), round(float(v), 1)) for u, v in zip(x, y, strict=True)],
        "deepest": f"{1e3 * deepest:.3g} mm",
        "strongest": f"{strongest:.3g} N",
    }
