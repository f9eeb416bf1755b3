"""Cast shadows of a simulated surface (tacsim.models.shadows)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tacsim.models.photometric import PhotometricLight
from tacsim.models.shadows import CastShadows, horizon
from tacsim.optics.grid import PixelGrid
from tacsim.optics.surface import SurfaceTable, bilinear_lookup

Float32 = NDArray[np.float32]

TABLE_STRIDE = 2  # every so many points of the table along each side: shadows have soft edges


def shadow_colours(light: PhotometricLight, shadows: CastShadows, table: SurfaceTable, image: PixelGrid) -> Float32:
    """(rows, columns, 3) change of colour by cast shadows at the table's points, of an image with these pixels.

    The way to a lamp is followed over the surface as if it had moved only up and down: sideways motion is small beside
    the length of a shadow.
    """
    x, y = (each[::TABLE_STRIDE, ::TABLE_STRIDE] for each in table.deformed_coordinates())
    u, v = image.image_coordinates(x, y)
    width, flat = np.float32(image.columns * image.pitch), np.float32(image.rows / image.columns)
    # from places in picture widths, which start in the middle of the picture, to metres
    start_x, start_y = x[0, 0] - u[0, 0] * width, y[0, 0] - v[0, 0] * flat * width
    height = np.ascontiguousarray(table.fields[..., 0])

    def height_at(x: Float32, y: Float32) -> Float32:
        return table.interpolate_at_rest(height, start_x + width * x, start_y + width * y) / width

    horizons = [horizon(height_at, u, v * flat, lamp) for lamp in shadows.lamps]
    rows, columns = (np.arange(n, dtype=np.float32) / TABLE_STRIDE for n in table.fields.shape[:2])
    return bilinear_lookup(light.shadow(horizons, u, v), np.stack(np.meshgrid(columns, rows), axis=-1))
