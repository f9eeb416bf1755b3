"""Data of the player in an episode's page: body, gels, pictures and curves at up to 120 moments."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.interface import FloatArray
from tacsim.models.task import unit_of
from tacsim.record.episode import Episode, Step
from tacsim.report.figure import encode_jpeg, select_positions, shrink_image
from tacsim.report.section import GelShape, GelState, gel_states, layer_numbers, particle_spacing
from tacsim.report.series import Series, sort_upper_first
from tacsim.report.strips import Find, height_image

MAX_MOMENTS = 120
# Of all moments, in base64; above it, every other moment is left out. The rest of a page has 0.8 MB with two sensors.
MAX_BYTES = 2_150_000
PICTURE, QUALITY = 240, 72  # width of a picture [px], its JPEG quality
GRID = 25  # points of a gel's surface along x, and along y
Image8 = NDArray[np.uint8]


def playback_data(
    episode: Episode, series: Series, find: Find, gels: Mapping[str, GelShape], positions: Sequence[int]
) -> dict[str, Any]:
    """What the page's script shows, as JSON can hold it. One step is decoded at a time. Lengths are in mm.

    positions: the steps to be shown; every other one is left out until the rest has at most MAX_BYTES.

    Returns:
        moments: of each: `at` (position in the curves), `step`, `body` (base64 of uint8, x, y, z of each particle, as a
            fraction of `space`), `gels` (by sensor: `pose`, 3 x 4 numbers, and `height`, base64 of int16 [um]),
            `pictures` (by name the index in `files`).
        files: JPEG pictures, base64. A picture that shows the same as the one before is stored once.
        pictures: width and height by name.
        space: `lower` corner and `size`. gels: size by sensor. layers, visible, spacing: see `_describe_particles`.
        curves: `title`, `unit`, `lines`.
    """
    first = episode.steps[positions[0]].body
    moments = [_Moment(at, episode.steps[at], series.sensors, find, gels) for at in positions]
    files: list[str] = []
    while True:
        packed, files = _pack(moments)
        if len(moments) <= 2 or _count_bytes(moments, packed, files) <= MAX_BYTES:
            break
        moments = [*moments[:-1:2], moments[-1]]
    bodies = [each.body for each in moments if each.body is not None]
    lower, size = _space(bodies)
    for each, row in zip(moments, packed, strict=True):
        row["body"] = None if each.body is None else _pack_points(each.body, lower, size)
    return {
        "moments": packed,
        "files": files,
        "pictures": {name: size for each in moments for name, size in each.picture_sizes().items()},
        "space": {"lower": (1e3 * lower).tolist(), "size": 1e3 * size},
        **_describe_particles(first),
        "grid": GRID,
        "gels": {name: [1e3 * side for side in shape.size] for name, shape in gels.items()},
        "steps": series.index.tolist(),
        "curves": _curves(series),
    }


class _Moment:
    """A step, reduced to what is shown; pictures stay arrays until it is known which are stored."""

    def __init__(self, at: int, step: Step, sensors: Sequence[str], find: Find, gels: Mapping[str, GelShape]) -> None:
        self.at, self.step = at, step.index
        self.body = step.body
        self.gels = {name: _pack_gel(state) for name, state in gel_states(step, gels, find).items()}
        self.pictures: dict[str, Image8] = {}
        self.heights: dict[str, NDArray[np.float32]] = {}
        for name in sensors:
            if name in step.frames:
                self.pictures[name] = shrink_image(step.frames[name].image, PICTURE)
                surface = find(name, step.frames[name])
                if surface is not None and surface.height is not None:
                    self.heights[f"{name} height"] = surface.height

    def picture_sizes(self) -> dict[str, tuple[int, int]]:
        """Width and height by name."""
        shapes = {name: image.shape for name, image in self.pictures.items()}
        shapes |= {name: height.shape for name, height in self.heights.items()}
        return {name: (shape[1], shape[0]) for name, shape in shapes.items()}


def _describe_particles(first: NDArray[np.float32] | None) -> dict[str, Any]:
    """Of each particle its `layer` of colour (0, 1) and where it is `visible`: 1 in space, 2 in the section, 3 in both.

    Particles whose neighbourhood, three spacings wide, is full are inside and need not be drawn in space.
    """
    from scipy.spatial import cKDTree

    if first is None:
        return {"layers": [], "visible": [], "spacing": 1.0}
    points = np.asarray(first, np.float64)
    spacing = particle_spacing(points)
    neighbours = cKDTree(points).query_ball_point(points, 3 * spacing, return_length=True)
    is_outer = neighbours < 0.9 * np.percentile(neighbours, 95)
    depth = points[:, 1] - (points[:, 1].min() + points[:, 1].max()) / 2
    in_section = (depth >= 0) & (is_outer | (depth < 3 * spacing))
    return {
        "layers": layer_numbers(points).tolist(),
        "visible": (is_outer + 2 * in_section).tolist(),
        "spacing": 1e3 * spacing,
    }


def _pack(moments: Sequence[_Moment]) -> tuple[list[dict[str, Any]], list[str]]:
    """Moments without their body, and the pictures they refer to."""
    deepest = max((float(height.max()) for each in moments for height in each.heights.values()), default=0.0)
    files: list[str] = []
    stored: dict[str, tuple[Image8, int]] = {}
    rows = []
    for each in moments:
        shown = each.pictures | {name: height_image(height, deepest) for name, height in each.heights.items()}
        numbers = {}
        for name in sorted(shown, key=lambda name: list(each.pictures).index(name.removesuffix(" height"))):
            picture = shown[name]
            if name not in stored or not is_same_picture(stored[name][0], picture):
                stored[name] = picture, len(files)
                files.append(_base64(encode_jpeg(picture, QUALITY)))
            numbers[name] = stored[name][1]
        rows.append({"at": each.at, "step": each.step, "gels": each.gels, "pictures": numbers})
    return rows, files


def is_same_picture(a: Image8, b: Image8) -> bool:
    """Whether two pictures (H, W, 3) differ only by noise: no block of 8 x 8 pixels by two grey levels or more."""
    import cv2

    block, max_difference = 8, 2.0
    if a.shape != b.shape:
        return False
    difference = a.astype(np.float32) - b.astype(np.float32)
    return bool(np.abs(cv2.blur(difference, (block, block))).max() < max_difference)


def _count_bytes(moments: Sequence[_Moment], rows: Sequence[Mapping[str, Any]], files: Sequence[str]) -> int:
    points = sum(0 if each.body is None else len(each.body) for each in moments)
    return 4 * points + sum(map(len, files)) + len(json.dumps(rows))  # a point: three uint8 in base64


def _space(bodies: Sequence[NDArray[np.float32]]) -> tuple[FloatArray, float]:
    """Lower corner (3,) and side [m] of a cube around all points."""
    if not bodies:
        return np.zeros(3), 1.0
    lower = np.min([each.min(axis=0) for each in bodies], axis=0).astype(np.float64)
    upper = np.max([each.max(axis=0) for each in bodies], axis=0).astype(np.float64)
    return lower, max(float((upper - lower).max()), 1e-6)


def _pack_points(points: NDArray[np.float32], lower: FloatArray, size: float) -> str:
    return _base64(np.rint((points - lower) / size * 255).astype(np.uint8).tobytes())


def _pack_gel(gel: GelState) -> dict[str, Any]:
    pose = se3.to_matrix(gel.pose)[:3]
    pose[:, 3] *= 1e3
    half = np.array(gel.shape.size[:2]) / 2
    x, y = np.meshgrid(np.linspace(-half[0], half[0], GRID), np.linspace(-half[1], half[1], GRID))
    height = np.clip(np.rint(1e6 * gel.height_at(x, y)), -32_768, 32_767).astype("<i2")
    return {"pose": np.round(pose, 5).tolist(), "height": _base64(height.tobytes())}


def _curves(series: Series) -> list[dict[str, Any]]:
    """Title, unit and values of each curve, None where a step has none."""
    shown = unit_of(series.meta.task)
    distances = {"truth": shown.factor * series.distance, "by touch": shown.factor * series.tactile_distance}
    groups: list[tuple[str, str, Mapping[str, FloatArray]]] = [
        ("force |Fz|", "N", series.force),
        ("reward", "", {"": series.reward}),
        ("distance", shown.symbol, distances),
        ("depth", "mm", {name: 1e3 * values for name, values in series.max_depth.items()}),
        ("contact signal", "", series.signals),
    ]
    found = []
    for title, unit, lines in groups:
        known = {
            name: [float(f"{value:.5g}") if np.isfinite(value) else None for value in values.tolist()]
            for name, values in ((name, lines[name]) for name in sort_upper_first(lines))
            if np.isfinite(values).any()
        }
        if known:
            found.append({"title": title, "unit": unit, "lines": known})
    return found


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


def moments_of(episode: Episode) -> list[int]:
    """Positions of the steps that a page can show."""
    return select_positions(len(episode.steps), MAX_MOMENTS)
