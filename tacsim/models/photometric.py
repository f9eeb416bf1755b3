"""Surface slope -> colour by a polynomial that was calibrated on a real sensor: what a Phong light cannot say.

With the unit normal's parts nx = -gx / k, ny = -gy / k, nz = 1 / k, k = sqrt(1 + gx^2 + gy^2), and u, v = the place in
the image, each from -1/2 to 1/2 across it, the relative change of colour (I - I0) / mean(I0) in each channel is

    sum over position terms 1, u, v, u^2, u v, v^2 (as many as `position` asks for) of
    sum over normal terms nx, ny, 1 - nz, nx^2, nx ny, ny^2, nx^3, ... (up to `degree`) of weight * product.

No term is constant: the flat gel shows I0. Degree 1 at position 0 is the most that directional diffuse lights can do.
What one place of the surface hides from another is added: tacsim.models.shadows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from tacsim.models.quantity import Config
from tacsim.models.shadows import CastShadows, shadow_terms

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

Weight = Annotated[float, Field(allow_inf_nan=False)]


class PhotometricModel(Config):
    """The forward model of one sensor's light."""

    degree: Annotated[int, Field(ge=1, le=5)]  # of the polynomial in nx, ny
    position: Annotated[int, Field(ge=0, le=2)]  # degree of the polynomial in u, v
    # Of R, G, B, one row a term; terms of one position stand together.
    weights: tuple[tuple[Weight, Weight, Weight], ...]
    steepest: Annotated[float, Field(gt=0, le=10)]  # slope up to which it was calibrated; steeper ones are clipped [-]
    blur: Annotated[float, Field(ge=0, le=10)] = 0.0  # standard deviation of the camera's blur [px]
    shadows: CastShadows | None = None  # None: none are seen

    @model_validator(mode="after")
    def _one_weight_a_term(self) -> Self:
        wanted = term_count(self.degree, self.position)
        if len(self.weights) != wanted:
            raise ValueError(
                f"weights has {len(self.weights)} rows; degree {self.degree} at position {self.position} has {wanted}"
            )
        return self


def term_count(degree: int, position: int) -> int:
    """Number of terms, that is of weights a channel."""
    return math.comb(degree + 2, 2) * math.comb(position + 2, 2)


def normal_terms(gradient: NDArray[np.floating], degree: int) -> NDArray[np.floating]:
    """(terms, ...) the terms of the normal for slopes (..., 2), in the order of the weights."""
    gx, gy = gradient[..., 0], gradient[..., 1]
    terms = np.empty((term_count(degree, 0), *gx.shape), dtype=gradient.dtype)
    nz = 1.0 / np.sqrt(1.0 + gx * gx + gy * gy)
    terms[0], terms[1], terms[2] = gx * -nz, gy * -nz, 1.0 - nz
    last, here = [0, 1], 3
    for _ in range(degree - 1):  # nx^a ny^b of one order higher: each by nx, and the last by ny
        for term, factor in [*((term, 0) for term in last), (last[-1], 1)]:
            np.multiply(terms[term], terms[factor], out=terms[here, ...])
            here += 1
        last = list(range(here - len(last) - 1, here))
    return terms


def position_terms(u: NDArray[np.floating], v: NDArray[np.floating], position: int) -> list[NDArray[np.floating]]:
    """The terms of the place in the image for u, v (...,) in -1/2..1/2."""
    products = [np.ones_like(u)]  # each by u, and the last by v, from one order to the next
    last = products
    for _ in range(position):
        last = [*(term * u for term in last), last[-1] * v]
        products = products + last
    return products


def place_in_image(columns: int, rows: int) -> tuple[Float64, Float64]:
    """u (columns,) and v (rows,) of the pixels of an image."""
    return (np.arange(columns) + 0.5) / columns - 0.5, (np.arange(rows) + 0.5) / rows - 0.5


def places_in_image(columns: int, rows: int) -> tuple[Float32, Float32]:
    """u and v (rows, columns) of the pixels of an image."""
    u, v = np.meshgrid(*place_in_image(columns, rows))
    return u.astype(np.float32), v.astype(np.float32)


def clipped(gradient: Float32, steepest: float) -> tuple[Float32, int]:
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
        self._terms = term_count(model.degree, 0)
        weights = (np.array(model.weights) * mean).astype(np.float32).reshape(-1, self._terms, 3)
        self._weights = np.ascontiguousarray(weights.transpose(0, 2, 1)).reshape(-1, self._terms)  # place and channel
        self._shadows = None if model.shadows is None else (np.array(model.shadows.weights) * mean).astype(np.float32)

    def change(self, gradient: Float32, u: Float32, v: Float32) -> tuple[Float32, int]:
        """(..., n, 3) change of colour under slopes (..., n, 2) at places u, v (..., n) in -1/2..1/2, before blur, and
        how many of these slopes were clipped to the calibrated range."""
        import cv2

        slopes, beyond = clipped(gradient, self._model.steepest)
        places = np.stack(position_terms(u, v, self._model.position))
        # Most of the work is this product of matrices, row by row: BLAS does one so small on this thread. A large one
        # it shares with threads that wait by spinning, which on a busy machine took 40 ms instead of half a one.
        normals = np.moveaxis(normal_terms(slopes, self._model.degree), 0, -2)  # (..., terms, n)
        at_places = (self._weights @ normals).reshape(*normals.shape[:-2], len(places), 3, -1)
        red, green, blue = np.einsum("...pcn,p...n->c...n", at_places, places)
        return np.asarray(cv2.merge([red, green, blue]), dtype=np.float32).reshape(*gradient.shape[:-1], 3), beyond

    def shadow(self, horizons: Sequence[Float32], u: Float32, v: Float32) -> Float32:
        """(..., 3) change of colour by cast shadows, for the horizons (...,) of each lamp at places u, v (...,), before
        blur. Of a model with shadows."""
        assert self._shadows is not None
        return np.asarray(np.tensordot(shadow_terms(horizons, u, v), self._shadows, axes=(0, 0)), dtype=np.float32)
