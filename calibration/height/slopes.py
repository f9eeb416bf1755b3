"""Colour -> slope: the inverse of a sensor's light, as a table of colours, as a polynomial fitted to labelled presses,
or from darkness for a light that shows depth and no direction (tacsim.models.photometric).

A model maps the relative change of colour (I - I0) / mean(I0) of each pixel to the slopes of the surface there.

The polynomial, of degree 3 in (R, G, B, x, y) together, predicts the parts (nx, ny) = (gx, gy) / sqrt(1 + |g|^2) of the
normal, which stay bounded where slopes do not (56 weights each; the order of Wang et al. 2021 with position).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from calibration.height.tuning import COLOUR_NOISE, MAX_COLOUR_DISTANCE, MAX_EXTRAPOLATION, MAX_TABLE_SLOPE, SLOPE_PRIOR
from tacsim.interface import Float32, FloatArray, Mask
from tacsim.models.photometric import DarknessModel, PhotometricLight, PhotometricModel
from tacsim.models.quantity import Config
from tacsim.models.sensor import Lighting, SensorModel
from tacsim.optics.render import phong_shading, untouched_image

TABLE_CELLS = 48  # along each colour
DEGREE = 3
TERMS = 56
COLOUR_SCALE = 2.4  # brings changes of colour to about -2..2, the size of x and y


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


Weight = Annotated[float, Field(allow_inf_nan=False)]


class InverseModel(Config):
    """The inverse model of one sensor's light."""

    weights: Annotated[tuple[tuple[Weight, Weight], ...], Field(min_length=TERMS, max_length=TERMS)]  # of nx, ny
    steepest: Annotated[float, Field(gt=0, le=10)]  # slope up to which it was calibrated [-]


class PolynomialSlopes:
    """An inverse model made ready for pixels at places x, y (H, W) in -1..1 across the sensor's own image."""

    def __init__(self, model: InverseModel, x: FloatArray, y: FloatArray) -> None:
        self._steepest = MAX_EXTRAPOLATION * model.steepest
        colours = [powers for powers in _colour_products() if powers]
        self._powers: list[tuple[int, ...]] = [(), *colours]
        maps = {powers: np.zeros((2, *x.shape)) for powers in self._powers}
        places: dict[tuple[int, ...], FloatArray] = {(): np.ones_like(x)}  # ten of them, each of many terms
        for (colour, place), weight in zip(_polynomial_terms(), model.weights, strict=True):
            if place not in places:
                places[place] = places[place[:-1]] * (x, y)[place[-1]]
            for axis in range(2):
                maps[colour][axis] += (weight[axis] * COLOUR_SCALE ** len(colour)) * places[place]
        self._maps = {powers: grid.astype(np.float32) for powers, grid in maps.items()}

    def __call__(self, change: Float32) -> tuple[Float32, Mask]:
        """Slopes (H, W, 2) of relative changes (H, W, 3); steeper slopes than calibrated are clipped."""
        colours = [np.ascontiguousarray(change[..., channel]) for channel in range(3)]
        products: dict[tuple[int, ...], Float32] = {}
        normal = self._maps[()].copy()  # all zero in fitted models
        product = np.empty_like(normal)
        for powers in self._powers[1:]:
            last = colours[powers[-1]]
            products[powers] = last if len(powers) == 1 else products[powers[:-1]] * last
            np.multiply(self._maps[powers], products[powers], out=product)
            normal += product
        square = normal[0] * normal[0] + normal[1] * normal[1]
        largest = np.float32(self._steepest / np.sqrt(1.0 + self._steepest**2))
        beyond = square > largest * largest
        if beyond.any():
            normal[:, beyond] *= largest / np.sqrt(square[beyond])
            square[beyond] = largest * largest
        slope = normal / np.sqrt(1.0 - square)
        return np.moveaxis(slope, 0, -1), np.asarray(beyond)


def inverse_features(change: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """(n, TERMS) of relative changes (n, 3) at places x, y (n,) in -1..1; contiguous per term."""
    inputs = np.stack([*(COLOUR_SCALE * change).T, x, y])
    found: dict[tuple[int, ...], int] = {}
    terms = np.empty((TERMS, len(x)))
    for row, (colour, place) in enumerate(_polynomial_terms()):
        factors = (*colour, *(3 + axis for axis in place))
        found[factors] = row
        if not factors:
            terms[row] = 1.0
        else:  # a term of one factor less, which comes before it, times its last
            np.multiply(terms[found[factors[:-1]]], inputs[factors[-1]], out=terms[row])
    return terms.T


def normal_of_slope(gradient: FloatArray) -> FloatArray:
    """(..., 2) parts of the unit normal in the plane, of slopes (..., 2)."""
    normal: FloatArray = gradient / np.sqrt(1.0 + (gradient**2).sum(axis=-1, keepdims=True))
    return normal


def fit_inverse(sets: Sequence[tuple[FloatArray, FloatArray]], *, with_position: bool) -> FloatArray:
    """(TERMS, 2) weights from normal equations, one pair (TERMS, TERMS), (TERMS, 2) a press; without `with_position`
    those of all terms in x and y are 0. Those without colour are always 0, because no change means no slope at any
    place. The ridge is proportional to the number of pixels, which is the first diagonal element."""
    ridge_weight = 1e-6  # ridge weight per pixel
    use = np.array(
        [i for i, (colour, axes) in enumerate(_polynomial_terms()) if colour and (with_position or not axes)]
    )
    square = sum((s[np.ix_(use, use)] for s, _ in sets), np.zeros((len(use), len(use))))
    right = sum((r[use] for _, r in sets), np.zeros((len(use), 2)))
    weights = np.zeros((TERMS, 2))
    weights[use] = np.linalg.solve(square + ridge_weight * square[0, 0] * np.eye(len(use)), right)
    return weights


def inverse_of_light(model: PhotometricModel) -> InverseModel:
    """The inverse of a forward model whose presses are not available: a polynomial through its colours at random
    slopes, up to its steepest, and random places. It does not see cast shadows or the colour of depth."""
    sample_count = 20_000  # of slopes and places; the weights have 56 rows
    rng = np.random.default_rng(0)
    steepness, angle = model.steepest * np.sqrt(rng.random(sample_count)), 2 * np.pi * rng.random(sample_count)
    slopes: FloatArray = np.stack([steepness * np.cos(angle), steepness * np.sin(angle)], axis=-1)
    u, v = rng.random((2, sample_count)) - 0.5
    seen = PhotometricLight(model).change(*(each.astype(np.float32) for each in (slopes, u, v)))[0]
    terms: FloatArray = inverse_features(seen.astype(np.float64), 2.0 * u, 2.0 * v)
    square: FloatArray = terms.T @ terms
    right: FloatArray = terms.T @ normal_of_slope(slopes)
    weights = fit_inverse([(square, right)], with_position=True)
    return InverseModel(weights=tuple((float(x), float(y)) for x, y in weights), steepest=model.steepest)


def _colour_products() -> list[tuple[int, ...]]:
    """Products of colours as sorted channels: (), (0,), ..., (0, 0), (0, 1), ..., (2, 2, 2)."""
    return [c for order in range(DEGREE + 1) for c in itertools.combinations_with_replacement(range(3), order)]


def _polynomial_terms() -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """(channels, axes) of every term: products of at most DEGREE colours and places together."""
    return [
        (colour, place)
        for colour in _colour_products()
        for order in range(DEGREE + 1 - len(colour))
        for place in itertools.combinations_with_replacement(range(2), order)
    ]


class DarknessSlopes:
    """The inverse of a darkness model on pictures of one shape: the table gives the depth beyond a share of that round
    it, a division in the cosine transform the depth itself, and differences of neighbours its slopes."""

    def __init__(self, model: DarknessModel, shape: tuple[int, int], pitch: float) -> None:
        """`shape`: rows, columns; `pitch`: distance of two pixels, in the model's unit."""
        smoothing_width = 1.0  # standard deviation of the Gaussian that takes off noise [px]
        waves = [np.pi * np.arange(count) / count for count in shape]
        square = waves[0][:, None] ** 2 + waves[1][None, :] ** 2  # [1 / px^2]
        round_it = model.share * np.exp(-square / 2 * (model.reach / pitch) ** 2)
        self._filter = (np.exp(-square / 2 * smoothing_width**2) / (1.0 - round_it)).astype(np.float32)
        self._depths = np.array(model.depths) / pitch
        self._darkness = -np.array(model.changes).mean(axis=1)

    def depth(self, change: Float32) -> tuple[Float32, Mask]:
        """(H, W) depth of relative changes (H, W, 3), and True where they are outside the table."""
        from scipy.fft import dctn, idctn

        darkness = -change.mean(axis=2)
        own = np.interp(darkness, self._darkness, self._depths).astype(np.float32)
        depth: Float32 = idctn(dctn(own, norm="ortho") * self._filter, norm="ortho")
        return depth, np.asarray((darkness < self._darkness[0]) | (darkness > self._darkness[-1]))

    def __call__(self, change: Float32) -> tuple[Float32, Mask]:
        """Slopes (H, W, 2) of relative changes (H, W, 3), and True where these are outside the table."""
        depth, beyond = self.depth(change)
        by_y, by_x = np.gradient(depth)
        return np.stack([by_x, by_y], axis=-1).astype(np.float32), beyond
