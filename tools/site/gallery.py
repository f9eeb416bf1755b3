"""The pictures of the gallery, drawn by the simulator, in docs/images: python -m tools.site.gallery

sensors.jpg: presses on each shipped sensor. press.jpg: a slid ball in picture, height and flow.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from robot import PressMotion, PressResult, press
from tacsim import load_scene, load_sensor
from tacsim.config.kinds import shipped_names
from tacsim.report.figure import new_figure, save_figure
from tools.site.pages import ROOT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BALL = "indenter.geometry={shape: sphere, radius: 4 mm}"
BOX = "indenter.geometry={shape: box, size: [6 mm, 4 mm, 4 mm]}"
PRESSES = {  # title: changes of the scene, depth [m]
    "ball, 0.8 mm": ([BALL], 0.8e-3),
    "box, 0.5 mm": ([BOX, "indenter.yaw=30 deg"], 0.5e-3),
    "cylinder on its side, 0.4 mm": (
        ["indenter.geometry={shape: cylinder, radius: 2 mm, height: 12 mm}", "indenter.pitch=90 deg"],
        0.4e-3,
    ),
}


def press_sensor(sensor: str, changes: list[str], motion: PressMotion) -> PressResult:
    """A press at standard resolution, as this sensor shows it."""
    return press(load_scene("press", ["preset=standard", *changes]), load_sensor(sensor), motion)


def draw_sensors(path: Path) -> None:
    """Each shipped sensor in a column, each press in a row."""
    sensors = shipped_names("sensor")
    figure = new_figure(2.1 * len(sensors), 2.0 * len(PRESSES))
    figure.set_layout_engine("constrained")
    for row, (title, (changes, depth)) in enumerate(PRESSES.items()):
        for column, sensor in enumerate(sensors):
            axes = figure.add_subplot(len(PRESSES), len(sensors), row * len(sensors) + column + 1)
            axes.imshow(press_sensor(sensor, changes, PressMotion(depth=depth)).image)
            axes.set(xticks=[], yticks=[])
            if row == 0:
                axes.set_title(sensor, fontsize=9)
            if column == 0:
                axes.set_ylabel(title, fontsize=8)
    save(figure, path)


def draw_press(path: Path) -> None:
    """A ball, pressed and slid by 1 mm: the picture, the height, and the motion of the surface."""
    geometry = load_sensor("ideal-markers").geometry
    result = press_sensor("ideal-markers", [BALL], PressMotion(depth=0.8e-3, slide=(1e-3, 0.0)))
    half_width, half_height = (0.5e3 * geometry.pixel_pitch * size for size in (geometry.width, geometry.height))
    figure = new_figure(10.5, 3.0)
    figure.set_layout_engine("constrained")
    left, middle, right = (figure.add_subplot(1, 3, place) for place in (1, 2, 3))
    extent = (-half_width, half_width, half_height, -half_height)  # [mm]
    left.imshow(result.image, extent=extent)
    left.set_title("picture with markers", fontsize=9)
    shown = middle.imshow(result.height * 1e3, extent=extent, cmap="viridis", interpolation="bilinear")
    figure.colorbar(shown, ax=middle, label="into the gel [mm]", shrink=0.8)
    middle.set_title("height", fontsize=9)
    surface = result.surface
    motion = surface.displacement[::2, ::2, :2] * 1e3
    x, y = (
        (origin + 2 * surface.spacing * np.arange(count)) * 1e3
        for origin, count in zip(surface.origin, motion.shape[:2], strict=True)
    )
    right.quiver(*np.meshgrid(x, y, indexing="ij"), motion[..., 0], motion[..., 1], angles="xy", color="C3", width=4e-3)
    right.set_aspect("equal")
    right.set_title("motion of the surface along the gel", fontsize=9)
    for axes in (left, middle, right):
        axes.set(xlim=extent[:2], ylim=extent[2:], xlabel="x [mm]")
        axes.tick_params(labelsize=7)
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Writes a JPEG, which needs a fifth of the space of a PNG for pictures of sensors."""
    buffer = io.BytesIO()
    save_figure(figure, buffer)
    Image.open(buffer).convert("RGB").save(path, quality=90, optimize=True)


def main() -> None:
    images = ROOT / "docs" / "images"
    draw_sensors(images / "sensors.jpg")
    draw_press(images / "press.jpg")


if __name__ == "__main__":
    main()
