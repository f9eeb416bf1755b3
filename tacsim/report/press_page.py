"""The page of a press: the picture, the height in 3-D, and the force over the depth; and pictures: sections of the
indenter through its lowest point, which show the pressing side, and the height map.

Pictures use Pillow and OpenCV, which a press needs anyway: the import of matplotlib takes longer than the press.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tacsim.geometry.pressing_side import section_lines
from tacsim.interface import Float32, FloatArray, Mask, Pose
from tacsim.models.scene import Gel, Shape
from tacsim.optics.grid import PixelGrid
from tacsim.report.report import data_url, render_page, script_hash, script_text, to_script_json

if TYPE_CHECKING:
    from PIL.Image import Image

WIDTH = 440  # of one section [px]
TITLE = "height into the gel [mm]; contact outlined"
MAX_POINTS = 72  # of the surface in 3-D, along its longer side
CURVE = (420, 300, 64)  # width, height and margin of the force curve [px]


def write_side_picture(
    path: Path, shape: Shape, pose: Pose, lowest: FloatArray, height: Float32, grid: PixelGrid, gel: Gel,
    title: str,
) -> None:  # fmt: skip
    """A PNG of two sections, along x and along y, through the point `lowest` (x, y) [m].

    pose: of the indenter in the sensor's frame; height: (H, W) of the gel's surface under each pixel of `grid` [m].
    Raises OSError.
    """
    margin, text_size = 48, 14  # around a section, of a letter [px]
    from PIL import Image as images
    from PIL import ImageDraw, ImageFont

    drawn = [_draw_section(shape, pose, axis, lowest, height, grid, gel) for axis in (0, 1)]
    tall = max(each.height for each in drawn)
    picture = images.new("RGB", (2 * WIDTH + 3 * margin, tall + 2 * margin), "white")
    pen = ImageDraw.Draw(picture, "RGB")
    pen.font = ImageFont.load_default(text_size)
    pen.text((picture.width / 2, margin / 2), title, "black", anchor="mm")
    for k, (each, along, across) in enumerate(zip(drawn, "xy", "yx", strict=True)):
        left, below = margin + k * (WIDTH + margin), margin + tall
        picture.paste(each, (left, below - each.height))
        words = f"section along {along} at {across} = {lowest[1 - k] * 1e3:.2f} mm; gel {gel.size[k] * 1e3:.3g} mm wide"
        pen.text((left + WIDTH / 2, below + margin / 2), words, "black", anchor="mm")
    picture.save(path, compress_level=4)


def _draw_section(
    shape: Shape, pose: Pose, axis: int, lowest: FloatArray, height: Float32, grid: PixelGrid, gel: Gel
) -> Image:
    """Draws the section along `axis`; to scale, z up."""
    backing_colour = (150, 150, 150)
    surface_colour = (0, 96, 140)
    gel_colour = (196, 224, 236)
    indenter_colour = (90, 100, 120)
    max_height = 0.8  # widths of a section: higher parts are cut off
    supersampled = 2  # drawn pixels for one pixel of the result, along each axis
    from PIL import Image as images
    from PIL import ImageDraw

    lines = section_lines(shape, pose, 1 - axis, float(lowest[1 - axis]))[:, :, [axis, 2]]
    wide = max(1.1 * gel.size[axis], min(2.2 * float(np.abs(lines[..., 0]).max(initial=0.0)), 2 * gel.size[axis]))
    scale = supersampled * WIDTH / wide  # [px/m]
    top = min(float(lines[..., 1].max(initial=0.0)) + 0.05 * wide, max_height * wide)
    bottom = -gel.size[2] - 0.04 * wide

    def pixels(points: FloatArray) -> list[tuple[float, float]]:
        return [((x + wide / 2) * scale, (top - z) * scale) for x, z in points]

    picture = images.new("RGB", (supersampled * WIDTH, round((top - bottom) * scale)), "white")
    pen = ImageDraw.Draw(picture)
    half, back = gel.size[axis] / 2, -gel.size[2]
    surface = _surface_points(axis, lowest, height, grid)
    outline = np.array([[-half, 0.0], *surface, [half, 0.0], [half, back], [-half, back]])
    pen.polygon(pixels(outline), fill=gel_colour)
    pen.rectangle([*pixels(np.array([[-half, back]]))[0], *pixels(np.array([[half, bottom]]))[0]], fill=backing_colour)
    for column in range(picture.width):  # between the first crossing and the second, the third and the fourth, ...
        x = (column + 0.5) / scale - wide / 2
        for low, high in _crossings(lines, x):
            pen.line([(column, (top - high) * scale), (column, (top - low) * scale)], fill=indenter_colour)
    pen.line(pixels(outline[: len(surface) + 2]), fill=surface_colour, width=2 * supersampled)
    return picture.resize((WIDTH, picture.height // supersampled), images.Resampling.LANCZOS)


def _crossings(lines: FloatArray, x: float) -> FloatArray:
    """(n, 2) lower and upper ends of the inside at `x`; lines: (m, 2, 2) of a closed outline, x and z [m]."""
    start, end = lines[:, 0], lines[:, 1]
    across = (start[:, 0] <= x) != (end[:, 0] <= x)
    start, end = start[across], end[across]
    z = np.sort(start[:, 1] + (x - start[:, 0]) / (end[:, 0] - start[:, 0]) * (end[:, 1] - start[:, 1]))
    return z[: len(z) // 2 * 2].reshape(-1, 2)


def _surface_points(axis: int, lowest: FloatArray, height: Float32, grid: PixelGrid) -> list[tuple[float, float]]:
    """Points of the gel's surface in the section: position along it, z [m]."""
    across = int(np.argmin(np.abs((grid.y if axis == 0 else grid.x) - lowest[1 - axis])))
    along = grid.x if axis == 0 else grid.y
    values = height[across] if axis == 0 else height[:, across]
    return [(float(place), -float(value)) for place, value in zip(along, values, strict=True) if np.isfinite(value)]


def write_height_picture(path: Path, height: Float32, contact: Mask, pitch: float) -> None:
    """A PNG of `height` (H, W) [m], with the border of `contact` (H, W); `pitch`: of its pixels [m]. Raises OSError."""
    picture_width, margin, text_size = 800, 60, 16  # of the whole picture, around the map, of a letter [px]
    tick_count = 5
    bar_width = 20  # of the colour scale [px]
    import cv2
    from PIL import Image as images
    from PIL import ImageDraw, ImageFont

    rows, columns = height.shape
    wide = picture_width - 3 * margin - bar_width
    high = round(wide * rows / columns)
    low, top = float(height.min()), float(height.max())
    levels = np.rint((height - low) * (255 / max(top - low, 1e-12))).astype(np.uint8)
    large = cv2.resize(levels, (wide, high), interpolation=cv2.INTER_LINEAR)
    scale = np.repeat(np.linspace(255, 0, high).astype(np.uint8)[:, None], bar_width, axis=1)
    colours, bar = (cv2.applyColorMap(each, cv2.COLORMAP_VIRIDIS)[..., ::-1] for each in (large, scale))
    colours = np.ascontiguousarray(colours)
    touching = cv2.resize(contact.astype(np.uint8), (wide, high), interpolation=cv2.INTER_NEAREST)
    borders, _ = cv2.findContours(touching, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    if not contact.all():
        cv2.drawContours(colours, borders, -1, (255, 255, 255), 1, cv2.LINE_AA)

    picture = images.new("RGB", (picture_width, high + 2 * margin), "white")
    picture.paste(images.fromarray(colours), (margin, margin))
    left = margin + wide + margin // 2
    picture.paste(images.fromarray(np.ascontiguousarray(bar)), (left, margin))
    pen = ImageDraw.Draw(picture, "RGB")
    pen.font = ImageFont.load_default(text_size)
    pen.text((margin + wide / 2, margin / 2), TITLE, "black", anchor="mm")
    half = columns * pitch * 5e2, rows * pitch * 5e2  # [mm]
    for share in np.linspace(0.0, 1.0, tick_count):
        x, y = margin + share * wide, margin + share * high
        pen.text((x, margin + high + margin / 4), f"{(2 * share - 1) * half[0]:.3g}", "black", anchor="mm")
        pen.text((margin - 8, y), f"{(2 * share - 1) * half[1]:.3g}", "black", anchor="rm")
        pen.text((left + bar_width + 8, y), f"{(top - share * (top - low)) * 1e3:.3f}", "black", anchor="lm")
    pen.text((margin + wide / 2, 1.65 * margin + high), "x [mm]; y downwards", "black", anchor="mm")
    picture.save(path, compress_level=4)


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
