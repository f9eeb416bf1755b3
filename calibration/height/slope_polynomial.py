"""Colour -> slope by a polynomial in colour and place that was fitted to labelled presses.

The polynomial, of degree 3 in (R, G, B, x, y) together, predicts the parts (nx, ny) = (gx, gy) / sqrt(1 + |g|^2) of the
normal, which stay bounded where slopes do not (56 weights each; the order of Wang et al. 2021 with position).
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import Field

from calibration.height.tuning import MAX_EXTRAPOLATION
from tacsim.interface import Float32, FloatArray, Mask
from tacsim.models.photometric import PhotometricLight, PhotometricModel
from tacsim.models.quantity import Config

DEGREE = 3
TERMS = 56
COLOUR_SCALE = 2.4  # brings changes of colour to about -2..2, the size of x and y

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
