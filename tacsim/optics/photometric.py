"""Surface slope -> colour by a polynomial that was calibrated on a real sensor: what a Phong light cannot say.

With the unit normal's parts nx = -gx / k, ny = -gy / k, nz = 1 / k, k = sqrt(1 + gx^2 + gy^2), and u, v = the place in
the image, each from -1/2 to 1/2 across it, the relative change of colour (I - I0) / mean(I0) in each channel is

    sum over position terms 1, u, v, u^2, u v, v^2 (as many as `position` asks for) of
    sum over normal terms nx, ny, 1 - nz, nx^2, nx ny, ny^2, nx^3, ... (up to `degree`) of weight * product.

No term is constant: the flat gel shows I0. Degree 1 at position 0 is the most that directional diffuse lights can do.
"""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from tacsim.quantity import Facts

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

Weight = Annotated[float, Field(allow_inf_nan=False)]


class PhotometricModel(Facts):
    """The forward model of one sensor's light."""

    degree: Annotated[int, Field(ge=1, le=5)]  # of the polynomial in nx, ny
    position: Annotated[int, Field(ge=0, le=2)]  # degree of the polynomial in u, v
    # Of R, G, B, one row a term; terms of one position stand together.
    weights: tuple[tuple[Weight, Weight, Weight], ...]
    steepest: Annotated[float, Field(gt=0, le=10)]  # slope up to which it was calibrated; steeper ones are clipped [-]
    blur: Annotated[float, Field(ge=0, le=10)] = 0.0  # standard deviation of the camera's blur [px]

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
    return len(_powers(degree)) * len(_places(position))


def normal_terms(gradient: NDArray[np.floating], degree: int) -> list[NDArray[np.floating]]:
    """The terms of the normal for slopes (..., 2), each (...,), in the order of the weights."""
    gx, gy = gradient[..., 0], gradient[..., 1]
    nz = 1.0 / np.sqrt(1.0 + gx * gx + gy * gy)
    nx, ny = -gx * nz, -gy * nz
    terms: list[NDArray[np.floating]] = [nx, ny, 1.0 - nz]
    last = [nx, ny]
    for _ in range(degree - 1):  # nx^a ny^b of one order higher: each by nx, and the last by ny
        last = [*(term * nx for term in last), last[-1] * ny]
        terms += last
    return terms


def position_terms(u: NDArray[np.floating], v: NDArray[np.floating], position: int) -> list[NDArray[np.floating]]:
    """The terms of the place in the image for u, v (...,) in -1/2..1/2."""
    return [u**a * v**b for a, b in _places(position)]


def place_in_image(columns: int, rows: int) -> tuple[Float64, Float64]:
    """u (columns,) and v (rows,) of the pixels of an image."""
    return (np.arange(columns) + 0.5) / columns - 0.5, (np.arange(rows) + 0.5) / rows - 0.5


def clipped(gradient: Float32, steepest: float) -> tuple[Float32, NDArray[np.bool_]]:
    """Slopes (..., 2) no steeper than `steepest`, of unchanged direction, and (...,) where they had been."""
    gx, gy = gradient[..., 0], gradient[..., 1]
    square = gx * gx + gy * gy
    beyond = square > steepest * steepest
    if not beyond.any():
        return gradient, beyond
    shorter = gradient.copy()
    shorter[beyond] *= (steepest / np.sqrt(square[beyond]))[:, None]
    return shorter, beyond


class PhotometricLight:
    """A model made ready for the pixels of one image."""

    def __init__(self, model: PhotometricModel, shape: tuple[int, int]) -> None:
        """`shape`: rows, columns."""
        self._model, self._shape = model, shape
        terms = len(_powers(model.degree))
        weights = np.array(model.weights, dtype=np.float64).reshape(-1, terms, 3)  # (places, terms, 3)
        u, v = place_in_image(shape[1], shape[0])
        places = np.stack(position_terms(*np.meshgrid(u, v), model.position))  # (places, rows, columns)
        # (terms, 3, rows, columns): the polynomial in the normal that holds at each pixel; one number where they agree
        self._weights: Float32 = np.einsum("ptc,pij->tcij", weights, places if model.position else places[:, :1, :1])
        self._weights = np.ascontiguousarray(self._weights, dtype=np.float32)

    def change(self, gradient: Float32, rows: slice) -> tuple[Float32, int]:
        """(n, columns, 3) relative change of colour under slopes (n, columns, 2) of the image rows `rows`, before blur,
        and how many of these slopes were clipped to the calibrated range."""
        slopes, beyond = clipped(gradient, self._model.steepest)
        terms = normal_terms(slopes, self._model.degree)
        weights = self._weights[:, :, rows] if self._model.position else self._weights
        change = np.empty((*gradient.shape[:2], 3), dtype=np.float32)
        product = np.empty(gradient.shape[:2], dtype=np.float32)
        for channel in range(3):
            total = terms[0] * weights[0, channel]
            for term, weight in zip(terms[1:], weights[1:], strict=True):
                np.multiply(term, weight[channel], out=product)
                total += product
            change[..., channel] = total
        return change, int(np.count_nonzero(beyond))


def _powers(degree: int) -> list[tuple[int, int]]:
    """Powers of nx, ny of the terms; (0, 0) stands for 1 - nz."""
    higher = [(order - b, b) for order in range(2, degree + 1) for b in range(order + 1)]
    return [(1, 0), (0, 1), (0, 0), *higher]


def _places(position: int) -> list[tuple[int, int]]:
    return [(order - b, b) for order in range(position + 1) for b in range(order + 1)]
