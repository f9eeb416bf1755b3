"""Dots printed on the gel: where they are when the surface has moved, and how they are drawn."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.optics.geometry import Markers, SensorGeometry
from tacsim.optics.spline import displacement_and_jacobian
from tacsim.scene import GelSurface

INK = 0.06  # what a dot leaves of the light [-]


def rest_positions(markers: Markers) -> NDArray[np.float64]:
    """(rows, columns, 2) x, y of the dots on the untouched gel, centred on the sensor axis [m]."""
    x = (np.arange(markers.columns) - (markers.columns - 1) / 2) * markers.pitch
    y = (np.arange(markers.rows) - (markers.rows - 1) / 2) * markers.pitch
    return np.stack(np.meshgrid(x, y), axis=-1)


def check_fits(markers: Markers, gel_size: tuple[float, float]) -> None:
    """Raises ValueError when a dot lies off the gel."""
    reach = np.abs(rest_positions(markers)[-1, -1]) + markers.radius
    if reach[0] > gel_size[0] / 2 or reach[1] > gel_size[1] / 2:
        raise ValueError(
            f"markers: {markers.rows} x {markers.columns} dots at {markers.pitch * 1e3:g} mm need a gel of "
            f"{reach[0] * 2e3:.2f} x {reach[1] * 2e3:.2f} mm, the gel is {gel_size[0] * 1e3:g} x "
            f"{gel_size[1] * 1e3:g} mm; take fewer rows or columns, or a smaller pitch"
        )


def marker_flow(surface: GelSurface, markers: Markers) -> NDArray[np.float32]:
    """(rows, columns, 2) in-plane displacement of the dots, sensor x, y [m]."""
    rest = rest_positions(markers)
    displacement, _ = displacement_and_jacobian(surface, rest.reshape(-1, 2))
    return displacement[:, :2].reshape(rest.shape).astype(np.float32)


def marker_positions(surface: GelSurface, markers: Markers, geometry: SensorGeometry) -> NDArray[np.float64]:
    """(rows, columns, 2) column u, row v of the dots in the image [px]."""
    return (rest_positions(markers) + marker_flow(surface, markers)) / geometry.pixel_pitch + geometry.principal


def marker_coverage(positions: NDArray[np.float64], radius: float, shape: tuple[int, int]) -> NDArray[np.float32]:
    """(rows, columns) share of each pixel that dots cover, for centres (..., 2) u, v and a radius [px].

    Anti-aliased at sub-pixel accuracy: the edge is a ramp one pixel wide. Dots outside the image are left out.
    """
    rows, columns = shape
    centres = positions.reshape(-1, 2)
    reach = int(np.ceil(radius + 1.0))
    offset = np.arange(-reach, reach + 1)
    u = np.rint(centres[:, 0]).astype(np.intp)[:, None, None] + offset[None, None, :]
    v = np.rint(centres[:, 1]).astype(np.intp)[:, None, None] + offset[None, :, None]
    distance = np.hypot(u - centres[:, 0, None, None], v - centres[:, 1, None, None])
    covered = np.clip(radius + 0.5 - distance, 0.0, 1.0)
    u, v = np.broadcast_to(u, covered.shape), np.broadcast_to(v, covered.shape)
    inside = (covered > 0) & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    coverage = np.zeros(shape, dtype=np.float32)
    np.maximum.at(coverage, (v[inside], u[inside]), covered[inside].astype(np.float32))
    return coverage


def marker_transmission(surface: GelSurface, markers: Markers, geometry: SensorGeometry) -> NDArray[np.float32]:
    """(H, W) share of its light that each pixel keeps under the dots of the deformed surface."""
    positions = marker_positions(surface, markers, geometry)
    coverage = marker_coverage(positions, markers.radius / geometry.pixel_pitch, (geometry.height, geometry.width))
    return np.float32(1.0) - np.float32(1.0 - INK) * coverage
