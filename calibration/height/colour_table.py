"""Colour -> slope: the inverse of a sensor's light.

A model maps the relative change of colour (I - I0) / mean(I0) of each pixel to the slopes of the surface there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.height.tuning import COLOUR_NOISE, MAX_COLOUR_DISTANCE, MAX_TABLE_SLOPE, SLOPE_PRIOR
from tacsim.interface import Float32
from tacsim.models.sensor import Lighting, SensorModel
from tacsim.optics.render import phong_shading, untouched_image

TABLE_CELLS = 48  # along each colour


class GradientModel(Protocol):
    """Inverse of the light of one sensor, on the pixels of one grid."""

    def __call__(self, change: Float32) -> tuple[Float32, NDArray[np.bool_]]:
        """(H, W, 2) slopes [-] of the relative change of colour (H, W, 3), and (H, W) True where that colour is outside
        the range of the model: there the slope is that of the nearest colour in it."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ColourTable:
    """Inverse of a light that is the same everywhere on the gel. Make it by :func:`table_of_lighting`.

    Each cell of colour space holds an affine map colour -> slope: the regularised Gauss-Newton step from the slope
    whose colour is nearest to the middle of the cell. So a coarse table is exact to second order.
    """

    low: Float32  # (3,) colour change at the lower corner of the first cell
    scale: Float32  # (3,) cells per unit of colour change
    maps: Float32  # (CELLS^3, 8) offset (2), then the columns (2,) of the matrix for each colour
    off_gamut: NDArray[np.bool_]  # (CELLS^3,) farther than MAX_COLOUR_DISTANCE from every colour of the light

    def __call__(self, change: Float32) -> tuple[Float32, NDArray[np.bool_]]:
        shape = change.shape[:2]
        colours = [np.ascontiguousarray(change[..., channel]) for channel in range(3)]
        index = np.zeros(shape, dtype=np.float32)  # whole numbers up to CELLS^3 are exact
        beyond = np.zeros(shape, dtype=np.bool_)
        for colour, low, scale in zip(colours, self.low, self.scale, strict=True):
            at = (colour - low) * scale
            beyond |= at < 0
            beyond |= at >= TABLE_CELLS
            np.clip(at, 0, TABLE_CELLS - 1, out=at)
            index *= TABLE_CELLS
            index += np.floor(at, out=at)
        flat = index.ravel().astype(np.intp)
        maps = np.ascontiguousarray(self.maps.take(flat, axis=0).T).reshape(8, *shape)
        slope = maps[:2]
        for channel, colour in enumerate(colours):
            part = maps[2 + 2 * channel : 4 + 2 * channel]
            part *= colour
            slope += part
        steep = np.abs(slope)
        beyond |= np.maximum(steep[0], steep[1]) > MAX_TABLE_SLOPE
        np.clip(slope, -MAX_TABLE_SLOPE, MAX_TABLE_SLOPE, out=slope)
        beyond |= self.off_gamut.take(flat).reshape(shape)
        return np.moveaxis(slope, 0, -1), beyond


def table_of_model(model: SensorModel) -> ColourTable:
    """The inverse of a simulated sensor's light, for its mean untouched colour. Raises the errors of
    :func:`table_of_lighting`, and ValueError for a background picture that cannot be read."""
    untouched = untouched_image(model.lighting, (model.geometry.height, model.geometry.width))
    red, green, blue = untouched.mean(axis=(0, 1), dtype=np.float64)
    return table_of_lighting(model.lighting, (float(red), float(green), float(blue)))


@lru_cache(maxsize=8)
def table_of_lighting(lighting: Lighting, background: tuple[float, float, float]) -> ColourTable:
    """Tabulates the inverse of a Phong light whose untouched gel shows the mean colour `background` (1 is white).

    If the light does not distinguish slopes (a flank turned away from all lights but one), the smallest one is used.
    Raises ValueError for a light that cannot be inverted: its colour does not change with the slope along both axes.
    """
    colour_margin = 0.08  # of the table beyond the colours of its light [-]
    slope_step = 0.02  # between the slopes at which the light is evaluated [-]
    base = np.array(background, dtype=np.float32)
    if not (base > 0).all():
        raise ValueError(f"lighting: the untouched gel is black in a channel {background}; no change is relative to it")
    steps = round(MAX_TABLE_SLOPE / slope_step)
    line = (np.arange(-steps, steps + 1) * slope_step).astype(np.float32)
    slopes = np.stack(np.meshgrid(line, line), axis=-1)
    flat = phong_shading(np.zeros((1, 1, 2), dtype=np.float32), lighting)

    def colours_at(at: Float32) -> Float32:
        relative: Float32 = (np.clip(base + phong_shading(at, lighting) - flat, 0.0, 1.0) - base) / base
        return relative

    colours = colours_at(slopes)
    shifts = np.eye(2, dtype=np.float32) * np.float32(slope_step / 2)
    by_slope = (
        np.stack([colours_at(slopes + shift) - colours_at(slopes - shift) for shift in shifts], axis=-1) / slope_step
    )
    if float(np.linalg.svd(by_slope[steps, steps], compute_uv=False)[1]) < COLOUR_NOISE / SLOPE_PRIOR:
        raise ValueError(
            "lighting: the colour of the gel does not determine its slope along both axes, so no height can be found; "
            "it needs lights from at least two sides, in different colours"
        )
    low = colours.min(axis=(0, 1)) - colour_margin
    scale = TABLE_CELLS / (colours.max(axis=(0, 1)) + colour_margin - low)
    lines = ((np.arange(TABLE_CELLS) + 0.5)[:, None] / scale + low).T
    middles = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest, off_gamut = _maximum_likelihood_slope(colours.reshape(-1, 3), slopes.reshape(-1, 2), middles)
    jacobian = by_slope.reshape(-1, 3, 2)[nearest].astype(np.float64)
    transposed = jacobian.transpose(0, 2, 1)
    matrix = np.linalg.solve(
        transposed @ jacobian + (COLOUR_NOISE / SLOPE_PRIOR) ** 2 * np.eye(2), transposed
    )  # (n, 2, 3)
    offset = slopes.reshape(-1, 2)[nearest] - np.einsum("nij,nj->ni", matrix, colours.reshape(-1, 3)[nearest])
    maps = np.concatenate([offset, matrix.transpose(0, 2, 1).reshape(-1, 6)], axis=1).astype(np.float32)
    return ColourTable(low.astype(np.float32), scale.astype(np.float32), maps, off_gamut)


def _maximum_likelihood_slope(
    colours: Float32, slopes: Float32, middles: Float32
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """For each cell (n, 3) the index of the most likely of the slopes (m, 2) with colours (m, 3): near in colour (in
    units of noise) and small (in units of the prior). Cells beyond MAX_COLOUR_DISTANCE (the mask (n,)) take the
    slope of the nearest cell within it, because a search for them would take many times longer."""
    from scipy.ndimage import distance_transform_edt
    from scipy.spatial import KDTree

    tree = KDTree(np.concatenate([colours / COLOUR_NOISE, slopes / SLOPE_PRIOR], axis=1))
    query = np.concatenate([middles / COLOUR_NOISE, np.zeros((len(middles), 2))], axis=1)
    distance, index = tree.query(query, eps=0.1, distance_upper_bound=MAX_COLOUR_DISTANCE / COLOUR_NOISE)
    off_gamut = ~np.isfinite(distance)
    where = distance_transform_edt(
        off_gamut.reshape(TABLE_CELLS, TABLE_CELLS, TABLE_CELLS), return_distances=False, return_indices=True
    )
    nearest_known = np.ravel_multi_index(tuple(where.reshape(3, -1)), (TABLE_CELLS, TABLE_CELLS, TABLE_CELLS))
    return np.asarray(index, dtype=np.intp)[nearest_known], np.asarray(off_gamut)
