"""The tactile flow of a sensor: by what its model or calibration says of its dots, or by nothing but their distance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from calibration.lens.rectification import (
    Rectification,
    rectification_of_geometry,
    rectification_of_view,
    region_mask,
    visible_box,
)
from calibration.lens.view import GelView
from calibration.markers.flow import MarkerFlow, NoMarkers, find_markers, marker_grid
from calibration.markers.lattice import NoLattice
from tacsim.models.geometry import PictureRegion
from tacsim.models.sensor import CanonicalGrid, Markers, SensorGeometry
from tacsim.optics.grid import canonical_image


def marker_flow(
    markers: Markers | None,
    geometry: SensorGeometry,
    gel_size: tuple[float, float],
    seen: GelView | None = None,
    region: PictureRegion | None = None,
) -> MarkerFlow | None:
    """The flow of known dots; None without. `seen`: the gel through lens and perspective; None: the picture is metric
    by itself. `region`: what of the native picture shows gel; None: all of it."""
    if markers is None:
        return None
    fine = marker_grid(markers, gel_size)
    rectify = rectification_of_geometry(geometry, gel_size, fine) if seen is None else rectification_of_view(seen, fine)
    return MarkerFlow(markers, rectify.within(region), fine, geometry.camera_distance)


def view_of_dots(
    pitch: float, untouched: NDArray[np.uint8], grid: CanonicalGrid, region: PictureRegion | None = None
) -> tuple[Rectification, MarkerFlow]:
    """Where the gel lies, and its flow, by dots `pitch` [m] apart in a native picture (rows, columns, 3) without
    contact. The camera looks straight on. Raises NoMarkers where no dots are seen."""
    picture = untouched
    if region is not None:
        shown = region_mask(region, untouched.shape[:2])
        level = np.median(untouched[shown], axis=0).astype(np.uint8)
        picture = np.where(shown[..., None], untouched, level)
    try:
        lattice, radius = find_markers(picture)
    except NoLattice as nothing:
        raise NoMarkers(f"{nothing}: marker_pitch needs the dots of the picture without contact") from None
    scale = pitch / lattice.pitch
    (rows, columns), (high, wide) = lattice.present.shape, untouched.shape[:2]
    geometry, size = SensorGeometry(width=wide, height=high, pixel_pitch=scale), (wide * scale, high * scale)
    markers = Markers(rows=rows, columns=columns, pitch=pitch, radius=radius * scale)
    flow = marker_flow(markers, geometry, size, region=region)
    assert flow is not None
    rectify = rectification_of_geometry(geometry, size, canonical_image(grid)).within(region)
    if region is not None:
        down, across = (side.stop - side.start for side in visible_box(shown))
        rectify = replace(rectify, size=(across * scale, down * scale))
    return rectify, flow
