"""Dots printed on the gel: their positions on the deformed surface, and how they are drawn."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tacsim.interface import Float32, FloatArray, Mask
from tacsim.models.scene import GelSurface
from tacsim.models.sensor import Markers, SensorGeometry
from tacsim.optics.spline import SplinePoints
from tacsim.optics.tuning import INK_TRANSMISSION


def rest_positions(markers: Markers) -> FloatArray:
    """(rows, columns, 2) x, y of the dots on the untouched gel [m]: an even lattice is centred on the sensor axis."""
    if markers.places is not None:
        return np.array(markers.places, dtype=np.float64)
    x = (np.arange(markers.columns) - (markers.columns - 1) / 2) * markers.pitch
    y = (np.arange(markers.rows) - (markers.rows - 1) / 2) * markers.pitch
    return np.stack(np.meshgrid(x, y), axis=-1)


def require_dots_on_gel(markers: Markers, gel_size: tuple[float, float]) -> None:
    """Raises ValueError when a dot lies off the gel."""
    reach = np.abs(rest_positions(markers)).reshape(-1, 2).max(axis=0) + markers.radius
    if reach[0] > gel_size[0] / 2 or reach[1] > gel_size[1] / 2:
        raise ValueError(
            f"markers: {markers.rows} x {markers.columns} dots at {markers.pitch * 1e3:g} mm need a gel of "
            f"{reach[0] * 2e3:.2f} x {reach[1] * 2e3:.2f} mm, the gel is {gel_size[0] * 1e3:g} x "
            f"{gel_size[1] * 1e3:g} mm; take fewer rows or columns, or a smaller pitch"
        )


def marker_flow(surface: GelSurface, markers: Markers) -> Float32:
    """(rows, columns, 2) in-plane displacement of the dots, sensor x, y [m]; of those behind a fold, too."""
    return _dot_displacement(surface, markers)[..., :2].astype(np.float32)


def marker_discs(surface: GelSurface, markers: Markers, geometry: SensorGeometry) -> tuple[FloatArray, FloatArray]:
    """(rows, columns, 2) column u, row v of the dots in the image, and (rows, columns) their radii [px].

    Raises ValueError when the gel is pressed up to the camera.
    """
    displacement = _dot_displacement(surface, markers)
    nearer = np.ones(displacement.shape[:2])
    if geometry.camera_distance is not None:
        room = geometry.camera_distance + displacement[..., 2]
        if not (room > 0).all():
            raise ValueError(
                f"the gel is pressed in {-displacement[..., 2].min() * 1e3:.2f} mm, up to the camera at "
                f"camera_distance {geometry.camera_distance * 1e3:g} mm; press less"
            )
        nearer = geometry.camera_distance / room
    scale = nearer / geometry.pixel_pitch
    centres = (rest_positions(markers) + displacement[..., :2]) * scale[..., None] + geometry.principal
    return centres, markers.radius * scale


def _dot_displacement(surface: GelSurface, markers: Markers) -> FloatArray:
    """(rows, columns, 3) of the dots, sensor axes [m]."""
    dots = _dots_on_lattice(markers, surface.displacement.shape, surface.spacing, surface.origin)
    return dots.displacement(surface).reshape(markers.rows, markers.columns, 3)


@lru_cache(maxsize=16)  # dots stay where they are printed
def _dots_on_lattice(
    markers: Markers, shape: tuple[int, ...], spacing: float, origin: tuple[float, float]
) -> SplinePoints:
    return SplinePoints.of(
        GelSurface(np.zeros(shape, np.float32), spacing, origin), rest_positions(markers).reshape(-1, 2)
    )


def marker_coverage(positions: FloatArray, radius: float | FloatArray, shape: tuple[int, int]) -> Float32:
    """(rows, columns) fraction of each pixel that dots cover, for centres (..., 2) u, v and radii (...) or one [px].

    Anti-aliased at sub-pixel accuracy: the edge is a ramp one pixel wide. Dots outside the image are left out.
    """
    rows, columns = shape
    centres = positions.reshape(-1, 2)
    radii = np.broadcast_to(radius, positions.shape[:-1]).reshape(-1, 1, 1)
    reach = int(np.ceil(radii.max(initial=0.0) + 1.0))
    offset = np.arange(-reach, reach + 1)
    u = np.rint(centres[:, 0]).astype(np.intp)[:, None, None] + offset[None, None, :]
    v = np.rint(centres[:, 1]).astype(np.intp)[:, None, None] + offset[None, :, None]
    distance = np.hypot(u - centres[:, 0, None, None], v - centres[:, 1, None, None])
    covered = np.clip(radii + 0.5 - distance, 0.0, 1.0)
    u, v = np.broadcast_to(u, covered.shape), np.broadcast_to(v, covered.shape)
    inside = (covered > 0) & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    coverage = np.zeros(shape, dtype=np.float32)
    np.maximum.at(coverage, (v[inside], u[inside]), covered[inside].astype(np.float32))
    return coverage


def _visible_dots(surface: GelSurface, markers: Markers, geometry: SensorGeometry, at_rest: Float32) -> Mask:
    """(rows, columns) False for dots of which no pixel round their centres shows anything."""
    rest = rest_positions(markers)
    places = (rest + _dot_displacement(surface, markers)[..., :2]) / geometry.pixel_pitch + geometry.principal
    rest = rest / geometry.pixel_pitch + geometry.principal
    reach = max(markers.radius / geometry.pixel_pitch, 2.0)
    visible = np.zeros(rest.shape[:2], dtype=np.bool_)
    for step in np.ndindex(3, 3):
        u, v = np.moveaxis(np.rint(places).astype(np.intp) + np.array(step) - 1, -1, 0)
        there = at_rest[v.clip(0, geometry.height - 1), u.clip(0, geometry.width - 1)]
        visible |= np.linalg.norm(there - rest, axis=-1) <= reach
    return visible


def marker_transmission(
    surface: GelSurface, markers: Markers, geometry: SensorGeometry, at_rest: Float32 | None = None
) -> Float32:
    """(H, W) fraction of its light that each pixel keeps under the dots of the deformed surface.

    at_rest: (H, W, 2) column, row [px] where what each pixel shows lies on the untouched gel: of a surface that folds
    over, whose hidden dots are not drawn.
    """
    centres, radii = marker_discs(surface, markers, geometry)
    if at_rest is not None:
        visible = _visible_dots(surface, markers, geometry, at_rest)
        centres, radii = centres[visible], radii[visible]
    coverage = marker_coverage(centres, radii, (geometry.height, geometry.width))
    return np.float32(1.0) - np.float32(1.0 - INK_TRANSMISSION) * coverage
