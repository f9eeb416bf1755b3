"""Surface slope -> colour by a polynomial that was calibrated on a real sensor: what a Phong light cannot say.

With the unit normal's parts nx = -gx / k, ny = -gy / k, nz = 1 / k, k = sqrt(1 + gx^2 + gy^2), and u, v = the place in
the image, each from -1/2 to 1/2 across it, the relative change of colour (I - I0) / mean(I0) in each channel is

    sum over position terms 1, u, v, u^2, u v, v^2 (as many as `position` asks for) of
    sum over normal terms nx, ny, 1 - nz, nx^2, nx ny, ny^2, nx^3, ... (up to `degree`) of weight * product.

No term is constant: the flat gel shows I0. Degree 1 at position 0 is the most that directional diffuse lights can do.
Two things that the slope does not tell are added: what is pressed in lies elsewhere in the light, and differs from I0
where it is flat, too (:class:`DepthColour`); and one place of the surface hides another (:class:`CastShadows`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from tacsim.interface import Float32, FloatArray
from tacsim.models.quantity import Config, Length

Floats = NDArray[np.floating]
Weight = Annotated[float, Field(allow_inf_nan=False)]


class DarknessModel(Config):
    """A light that shows depth and no direction: a translucent skin that darkens where it is pressed in.

    What counts is the depth y of a point beyond a share of the mean depth round it,

        y = h - share * (Gaussian mean of h, standard deviation `reach`),

    because a dent throws light back on the gel around it: real pictures are brighter round a contact than without one.
    The relative change of colour is a table of y, the same everywhere. It is monotone, so it works both ways.
    """

    depths: Annotated[tuple[Length, ...], Field(min_length=2, max_length=256)]  # y, rising; below 0 next to a dent [m]
    changes: tuple[tuple[Weight, Weight, Weight], ...]  # of R, G, B at each depth; their mean falls
    share: Annotated[float, Field(ge=0, le=0.8)] = 0.0  # of the mean depth round a point
    reach: Annotated[Length, Field(gt=0)] = 1e-3  # of that mean [m]

    @model_validator(mode="after")
    def _is_monotone(self) -> Self:
        if len(self.changes) != len(self.depths):
            raise ValueError(f"changes has {len(self.changes)} rows, depths has {len(self.depths)} numbers")
        means = [sum(change) for change in self.changes]
        if any(b <= a for a, b in pairwise(self.depths)):
            raise ValueError("depths must rise")
        if any(b >= a for a, b in pairwise(means)):
            raise ValueError("changes: each row must be darker in the mean than the one before")
        return self

    def scaled(self, factor: float) -> DarknessModel:
        """The same in another unit of length."""
        return self.model_copy(
            update={"depths": tuple(factor * depth for depth in self.depths), "reach": factor * self.reach}
        )


SHADOW_SLOPES = (0.1, 0.3, 0.75)  # horizons at which it begins to get dark [-]
SHADOW_WIDTH = 1.5
SHADOW_STEPS = tuple(0.012 * 1.3**k for k in range(14))  # from 1/80 to a third of the picture
SHADOW_PLACES = 3  # position terms: 1, u, v


class CastShadows(Config):
    """The shadows of one sensor, whose lamps stand low next to the gel, as in a DIGIT: to the camera a dent is a bump.

    A place of the surface is darker where the path to the lamp is steep:

        horizon = max over SHADOW_STEPS s of (h(x + s e) - h(x)) / s,    e = direction from the place x to the lamp,

    with the height h into the gel. The relative change of colour is, in each channel, the sum

        over lamps, over SHADOW_SLOPES, over position terms 1, u, v of weight * ramp,

    where `ramp` goes from 0 to 1 as the horizon goes from that slope to SHADOW_WIDTH times it. Neither the height of a
    lamp nor its size is assumed. Lengths are in widths of the picture, places from its middle, x right, y down.
    """

    lamps: Annotated[
        tuple[tuple[Weight, Weight], ...], Field(min_length=1, max_length=8)
    ]  # x, y in the picture's plane
    weights: tuple[tuple[Weight, Weight, Weight], ...]  # of R, G, B; rows by lamp, then by slope, then by position term

    @model_validator(mode="after")
    def _require_weight_count(self) -> Self:
        wanted = len(self.lamps) * len(SHADOW_SLOPES) * SHADOW_PLACES
        if len(self.weights) != wanted:
            raise ValueError(f"weights has {len(self.weights)} rows; shadows of {len(self.lamps)} lamps have {wanted}")
        return self


def horizon_slope(
    height: Callable[[Floats, Floats], Floats], x: Floats, y: Floats, lamp: tuple[float, float]
) -> Floats:
    """(...,) steepest way up towards the lamp from places x, y (...,), at least 0; `height` of places."""
    min_distance = 1e-3  # closer to a lamp, its direction is not defined
    to_x, to_y = lamp[0] - x, lamp[1] - y
    distance = np.sqrt(to_x * to_x + to_y * to_y) + x.dtype.type(min_distance)
    to_x, to_y = to_x / distance, to_y / distance
    here = height(x, y)
    steepest = np.zeros_like(here)
    for step in map(x.dtype.type, SHADOW_STEPS):
        np.maximum(steepest, (height(x + step * to_x, y + step * to_y) - here) / step, out=steepest)
    return steepest


def shadow_terms(horizons: Sequence[Floats], u: Floats, v: Floats) -> Floats:
    """(terms, ...) for the horizons (...,) of each lamp at places u, v (...,) in -1/2..1/2 across the picture, in the
    order of the weights."""
    places = (np.ones_like(u), u, v)
    ramps = [
        np.clip((towards - slope) / ((SHADOW_WIDTH - 1) * slope), 0.0, 1.0).astype(u.dtype)
        for towards in horizons
        for slope in SHADOW_SLOPES
    ]
    return np.stack([ramp * place for ramp in ramps for place in places])


DEPTH_TERMS, DEPTH_POWERS = 5, 3


class DepthColour(Config):
    """What depth changes of a colour: pressed gel is nearer to lamps and camera, and thinner.

    With w = height into the gel / `deepest`, in 0..1 (beyond, as at the end), the relative change in each channel is
    the sum over DEPTH_TERMS w, w u, w v, w^2, w^3 of weight * term, whatever the slope; and w times the sum over the
    normal terms of `slopes` * term: w is a third coordinate of the place, in addition to u and v.
    """

    deepest: Annotated[float, Field(gt=0, le=10)]  # height up to which it was calibrated [widths of the picture]
    weights: Annotated[
        tuple[tuple[Weight, Weight, Weight], ...], Field(min_length=DEPTH_TERMS, max_length=DEPTH_TERMS)
    ]  # of R, G, B
    slopes: tuple[tuple[Weight, Weight, Weight], ...] = ()  # a row a normal term; (): slopes look alike at all depths


class PhotometricModel(Config):
    """The forward model of one sensor's light."""

    degree: Annotated[int, Field(ge=1, le=5)]  # of the polynomial in nx, ny
    position: Annotated[int, Field(ge=0, le=2)]  # degree of the polynomial in u, v
    # Of R, G, B, one row a term; terms of one position stand together.
    weights: tuple[tuple[Weight, Weight, Weight], ...]
    steepest: Annotated[float, Field(gt=0, le=10)]  # slope up to which it was calibrated; steeper ones are clipped [-]
    blur: Annotated[float, Field(ge=0, le=10)] = 0.0  # standard deviation of the camera's blur [px]
    shadows: CastShadows | None = None  # None: none are seen
    depth: DepthColour | None = None  # None: flat gel has one colour, however deep it is pressed

    @model_validator(mode="after")
    def _require_weight_count(self) -> Self:
        wanted = term_count(self.degree, self.position)
        if len(self.weights) != wanted:
            raise ValueError(
                f"weights has {len(self.weights)} rows; degree {self.degree} at position {self.position} has {wanted}"
            )
        rows, normals = len(self.depth.slopes) if self.depth else 0, term_count(self.degree, 0)
        if rows not in (0, normals):
            raise ValueError(f"depth.slopes has {rows} rows; degree {self.degree} has {normals}, or none")
        return self


def term_count(degree: int, position: int) -> int:
    """Number of terms, that is of weights a channel."""
    return math.comb(degree + 2, 2) * math.comb(position + 2, 2)


def normal_terms(gradient: Floats, degree: int, more: int = 0) -> Floats:
    """(terms, ...) the terms of the normal for slopes (..., 2), in the order of the weights; and `more` rows that are
    left to be filled."""
    gx, gy = gradient[..., 0], gradient[..., 1]
    count = term_count(degree, 0)
    terms = np.empty((count + more, *gx.shape), dtype=gradient.dtype)
    nx, ny, tilt = terms[0, ...], terms[1, ...], terms[2, ...]
    np.divide(-1.0, np.sqrt(1.0 + gx * gx + gy * gy), out=tilt)  # -nz
    np.multiply(gx, tilt, out=nx)
    np.multiply(gy, tilt, out=ny)
    tilt += 1.0
    _fill_products(terms[:count], (nx, ny), order=2, last=0, here=3)
    return terms


def position_terms(u: Floats, v: Floats, position: int) -> Floats:
    """(terms, ...) the terms of the place in the image for u, v (...,) in -1/2..1/2."""
    terms = np.empty((math.comb(position + 2, 2), *u.shape), dtype=u.dtype)
    terms[0] = 1.0
    _fill_products(terms, (u, v), order=1, last=0, here=1)
    return terms


def _fill_products(terms: Floats, factors: tuple[Floats, Floats], order: int, last: int, here: int) -> None:
    """Fills `terms` from row `here` on with the products of two factors of this `order` and higher ones. The `order`
    products of one order less start at row `last`: each by the first factor, and the last of them by the second."""
    first, second = factors
    while here < len(terms):
        np.multiply(terms[last : last + order], first, out=terms[here : here + order])
        np.multiply(terms[last + order - 1], second, out=terms[here + order, ...])
        last, here, order = here, here + order + 1, order + 1


def depth_terms(height: Floats, deepest: float, u: Floats, v: Floats) -> Floats:
    """(DEPTH_TERMS, ...) for heights (...,) into the gel, in the unit of `deepest`, at places u, v in -1/2..1/2."""
    w = relative_depth(height, deepest)
    return np.stack([w, w * u, w * v, w * w, w * w * w])


def relative_depth(height: Floats, deepest: float) -> Floats:
    """(...,) w in 0..1 for heights (...,) into the gel, in the unit of `deepest`."""
    return np.clip(height * height.dtype.type(1 / deepest), 0, 1)


def image_axes(columns: int, rows: int) -> tuple[FloatArray, FloatArray]:
    """u (columns,) and v (rows,) of the pixels of an image."""
    return (np.arange(columns) + 0.5) / columns - 0.5, (np.arange(rows) + 0.5) / rows - 0.5


def image_grid_places(columns: int, rows: int) -> tuple[Float32, Float32]:
    """u and v (rows, columns) of the pixels of an image."""
    u, v = np.meshgrid(*image_axes(columns, rows))
    return u.astype(np.float32), v.astype(np.float32)


def clip_slopes(gradient: Float32, steepest: float) -> tuple[Float32, int]:
    """Slopes (..., 2) no steeper than `steepest`, of unchanged direction, and how many had been. In memory the slopes
    by x and those by y lie apart."""
    planes = np.ascontiguousarray(np.moveaxis(gradient, -1, 0))
    square = planes[0] * planes[0] + planes[1] * planes[1]
    beyond = square > np.float32(steepest * steepest)
    count = int(np.count_nonzero(beyond))
    if count:
        planes = np.where(beyond, planes * (np.float32(steepest) / np.sqrt(np.maximum(square, 1e-30))), planes)
    return np.moveaxis(planes, 0, -1), count


class PhotometricLight:
    """A model made ready for use: its weights as arrays."""

    def __init__(self, model: PhotometricModel, mean: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> None:
        """mean: the untouched image's mean colour, by which changes are multiplied; 1: they stay relative."""
        self._model = model
        self._surface = _weights_by_place(model.weights, term_count(model.degree, 0), mean)
        self._deep = None if model.depth is None else _append_depth_weights(self._surface, model.depth, mean)
        self._shadows = None if model.shadows is None else (np.array(model.shadows.weights) * mean).astype(np.float32)

    def change(self, gradient: Float32, u: Float32, v: Float32, height: Float32 | None = None) -> tuple[Float32, int]:
        """(..., n, 3) change of colour under slopes (..., n, 2) at places u, v (..., n) in -1/2..1/2, before blur, and
        how many of these slopes were clipped to the calibrated range. `height` (..., n) into the gel [widths of the
        picture], which counts where the model knows depth; None: as at the surface."""
        import cv2

        degree, position, depth = self._model.degree, self._model.position, self._model.depth
        slopes, beyond = clip_slopes(gradient, self._model.steepest)
        if height is None or depth is None or self._deep is None:
            weights, terms, places = self._surface, normal_terms(slopes, degree), position_terms(u, v, position)
        else:
            weights, terms = self._deep, normal_terms(slopes, degree, more=DEPTH_POWERS)
            places = position_terms(u, v, max(position, 1))
            w, square, cube = terms[-DEPTH_POWERS:]
            w[...] = relative_depth(height, depth.deepest)
            np.multiply(w, w, out=square)
            np.multiply(square, w, out=cube)
            if depth.slopes:
                places = np.concatenate([places, w[None]])
        # Most of the work is this product of matrices, row by row: BLAS does one so small on this thread. A large one
        # it shares with threads that wait by spinning, which on a busy machine took 40 ms instead of half a one.
        at_places = np.empty((*weights.shape[:2], *u.shape), dtype=np.float32)
        by_row = np.moveaxis(at_places.reshape(-1, *u.shape), 0, -2)
        np.matmul(weights.reshape(-1, len(terms)), np.moveaxis(terms, 0, -2), out=by_row)
        count = len(places)
        red, green, blue = np.einsum("pcn,pn->cn", at_places.reshape(count, 3, -1), places.reshape(count, -1))
        return np.asarray(cv2.merge([red, green, blue]), dtype=np.float32).reshape(*gradient.shape[:-1], 3), beyond

    def shadow_change(self, horizons: Sequence[Float32], u: Float32, v: Float32) -> Float32:
        """(..., 3) change of colour by cast shadows, for the horizons (...,) of each lamp at places u, v (...,), before
        blur. Of a model with shadows."""
        assert self._shadows is not None
        return np.asarray(np.tensordot(shadow_terms(horizons, u, v), self._shadows, axes=(0, 0)), dtype=np.float32)


def _weights_by_place(weights: Sequence[Sequence[float]], terms: int, mean: Sequence[float]) -> Float32:
    """(places, 3, terms) of `weights` (places * terms, 3), times the colour `mean`."""
    scaled = np.array(weights).reshape(-1, terms, 3) * mean
    return np.ascontiguousarray(scaled.transpose(0, 2, 1), dtype=np.float32)


def _append_depth_weights(surface: Float32, depth: DepthColour, mean: Sequence[float]) -> Float32:
    """(places, 3, terms) weights of the `surface` with those of a colour of depth: w, w^2 and w^3 are DEPTH_POWERS more
    terms in addition to those of the normal, and w one more place if slopes look otherwise at depth."""
    linear, by_u, by_v, square, cube = (np.array(depth.weights) * mean).astype(np.float32)
    places, _, terms = surface.shape
    slopes = _weights_by_place(depth.slopes, terms, mean)
    own = max(places, 3)  # 1, u and v in any case
    weights = np.zeros((own + len(slopes), 3, terms + DEPTH_POWERS), dtype=np.float32)
    weights[:places, :, :terms], weights[own:, :, :terms] = surface, slopes
    weights[0, :, terms:] = np.stack([linear, square, cube], axis=-1)
    weights[1, :, terms], weights[2, :, terms] = by_u, by_v
    return weights
