"""Strips of each sensor over an episode: its pictures, and height, slope and flow if they are known."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from tacsim.interface import SurfaceMap, TactileFrame, TactileObservation
from tacsim.record.episode import Episode
from tacsim.report.figure import THUMBNAIL, Picture, select_positions, shrink_image
from tacsim.report.series import Series

Known = SurfaceMap | TactileObservation  # both have height, gradient and flow
Find = Callable[[str, TactileFrame], Known | None]
Rgb = NDArray[np.uint8]

MAP_PIXELS = 256  # of a map's picture, about [px]


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """Pictures in a row."""

    label: str  # short
    title: str
    note: str  # in words
    pictures: Sequence[Picture]


def sensor_strips(
    episode: Episode, series: Series, max_count: int, find: Find, among: Collection[int] | None = None
) -> list[Strip]:
    """Strips of every sensor with at most `max_count` steps over the episode; one picture is decoded at a time.

    among: positions of the steps to select from; by default all.
    """
    found: list[Strip] = []
    for sensor in series.sensors:
        positions = series.steps_with_image(sensor)
        if among is not None:
            positions = [at for at in positions if at in among] or positions[:1]
        pictures: list[Picture] = []
        surfaces: list[tuple[int, Known]] = []
        for k in select_positions(len(positions), max_count):
            step = episode.steps[positions[k]]
            frame = step.frames[sensor]
            pictures.append(Picture(step.index, shrink_image(frame.image, THUMBNAIL)))
            surface = find(sensor, frame)
            if surface is not None:
                surfaces.append((step.index, surface))
        found.append(Strip(sensor, f"Sensor {sensor}", f"{len(pictures)} of {len(positions)} frames", pictures))
        if surfaces:
            found += _map_strips(sensor, surfaces)
    return found


def _map_strips(sensor: str, surfaces: Sequence[tuple[int, Known]]) -> list[Strip]:
    """Strips of height, slope and flow, each with one scale for all steps."""
    made = []
    heights = [(index, surface.height) for index, surface in surfaces if surface.height is not None]
    if heights:
        deepest = max(float(height.max()) for _, height in heights)
        words = f"into the gel, dark 0, bright {deepest * 1e3:.3g} mm"
        pictures = [Picture(index, height_image(height, deepest)) for index, height in heights]
        made.append(Strip(f"{sensor}: height", f"{sensor}: height", words, pictures))
    slopes = [(index, surface.gradient) for index, surface in surfaces if surface.gradient is not None]
    if slopes:
        steepest = max(float(np.abs(slope).max()) for _, slope in slopes)
        words = f"grey 0; red the more, the deeper the gel goes to the right, green downwards; up to {steepest:.2g}"
        pictures = [Picture(index, _slope_image(slope, steepest)) for index, slope in slopes]
        made.append(Strip(f"{sensor}: slope", f"{sensor}: slope", words, pictures))
    flows = [(index, surface.flow) for index, surface in surfaces if surface.flow is not None]
    if flows:
        longest = max(float(np.linalg.norm(flow, axis=2).max()) for _, flow in flows)
        words = f"of the gel's surface sideways, an arrow a marker; the longest is {longest * 1e3:.3g} mm"
        pictures = [Picture(index, _flow_image(flow, longest)) for index, flow in flows]
        made.append(Strip(f"{sensor}: flow", f"{sensor}: flow", words, pictures))
    return made


def height_image(height: NDArray[np.float32], deepest: float) -> Rgb:
    """Colours of a height map (h, w) [m], from 0 to `deepest`; enlarged."""
    import cv2

    levels = np.clip(255 * height / max(deepest, 1e-9), 0, 255).astype(np.uint8)
    return _enlarge_image(np.asarray(cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)[..., ::-1], dtype=np.uint8))


def _slope_image(gradient: NDArray[np.float32], steepest: float) -> Rgb:
    levels = 127.0  # grey levels for the steepest slope
    colours = np.full((*gradient.shape[:2], 3), 128.0)
    colours[..., :2] += levels * gradient / max(steepest, 1e-9)
    return _enlarge_image(np.clip(np.rint(colours), 0, 255).astype(np.uint8))


def _enlarge_image(image: Rgb) -> Rgb:
    factor = max(1, MAP_PIXELS // max(image.shape[:2]))
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def _flow_image(flow: NDArray[np.float32], longest: float) -> Rgb:
    """Arrows on a regular lattice, all with one scale."""
    max_arrow = 0.9  # of a flow, over the distance of two arrows
    rows, columns, _ = flow.shape
    spacing = MAP_PIXELS / max(rows, columns)
    image = Image.new("RGB", (round(columns * spacing), round(rows * spacing)), "white")
    pen = ImageDraw.Draw(image)
    scale = max_arrow * spacing / max(longest, 1e-9)
    for (row, column), (x, y) in zip(np.ndindex(rows, columns), flow.reshape(-1, 2).tolist(), strict=True):
        u, v = (column + 0.5) * spacing, (row + 0.5) * spacing
        pen.line((u, v, u + scale * x, v + scale * y), fill="#2a6db5", width=2)
        pen.ellipse((u - 2, v - 2, u + 2, v + 2), fill="#22262b")
    return np.asarray(image, dtype=np.uint8)
