"""Weights of a photometric model from labelled presses, and their errors on left-out presses.

Only the normal equations of each press are stored, so any number of presses, sizes and left-out presses needs one pass
over the pixels.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from calibration.light import tuning
from tacsim.interface import FloatArray
from tacsim.models.photometric import DEPTH_TERMS, normal_terms, position_terms, term_count

MAX_SIZE = (5, 2)  # degree in the normal, degree in the place
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3)  # times the mean of the diagonal of the normal equations
# pixels in one sum: with fewer the threads of BLAS start too often, more do not fit into the cache
CHUNK_PIXELS = 16384
SLOPE_TERMS = term_count(MAX_SIZE[0], 0)


@dataclass(frozen=True, slots=True)
class ModelSize:
    """Size of a photometric model."""

    degree: int
    position: int
    ridge: float
    depth: int = 0  # terms of the depth
    slopes: int = 0  # terms of slopes at depth
    shadows: int = 0  # terms of cast shadows

    @property
    def terms(self) -> int:
        return term_count(self.degree, self.position) + self.depth + self.slopes + self.shadows


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Normal equations of one press for the terms of MAX_SIZE, and after them those of depth, of slopes at depth and of
    cast shadows. Each channel has its own if pixels are saturated in one and not in another."""

    square: FloatArray  # (1, terms, terms) of all channels, or (3, terms, terms)
    right: FloatArray  # (terms, 3)
    power: float  # sum of the squares of the changes of colour
    count: int  # numbers summed

    def __add__(self, other: NormalEquations) -> NormalEquations:
        """The equations of the pixels of both."""
        return NormalEquations(
            self.square + other.square, self.right + other.right, self.power + other.power, self.count + other.count
        )

    def __sub__(self, part: NormalEquations) -> NormalEquations:
        """The equations without the pixels of a part."""
        return NormalEquations(
            self.square - part.square, self.right - part.right, self.power - part.power, self.count - part.count
        )


def photometric_features(gradient: FloatArray, u: FloatArray, v: FloatArray, degree: int, position: int) -> FloatArray:
    """(n, terms) for slopes (n, 2) at places u, v (n,) in -1/2..1/2."""
    normal = np.ascontiguousarray(np.moveaxis(normal_terms(gradient, degree), 0, -1))
    place = np.moveaxis(position_terms(u, v, position), 0, -1)
    return np.asarray((place[:, :, None] * normal[:, None, :]).reshape(len(gradient), -1), dtype=np.float64)


def normal_equations(
    gradient: FloatArray,
    u: FloatArray,
    v: FloatArray,
    change: FloatArray,
    lit: NDArray[np.bool_] | None = None,
    extra_terms: FloatArray | None = None,
) -> NormalEquations:
    """Of n pixels: slopes (n, 2), places (n,), relative changes of colour (n, 3); `lit` (n, 3): what is not saturated,
    and counts; None: all; `extra_terms` (n, terms): of depth and cast shadows; None: there are none."""
    more = np.zeros((len(u), 0)) if extra_terms is None else extra_terms
    if lit is None or lit.all():
        square, right = _normal_sums_with_extra(gradient, u, v, change, more)
        return NormalEquations(square[None], right, float((change**2).sum()), change.size)
    counted = change * lit
    square, right = _normal_sums_with_extra(gradient, u, v, counted, more)
    squares = []
    for saturated in (~lit).T:
        lost, _ = _normal_sums_with_extra(
            gradient[saturated], u[saturated], v[saturated], counted[saturated], more[saturated]
        )
        squares.append(square - lost)
    return NormalEquations(np.stack(squares), right, float((counted**2).sum()), int(lit.sum()))


def _normal_sums_with_extra(
    gradient: FloatArray, u: FloatArray, v: FloatArray, change: FloatArray, extra_terms: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """G^T G and G^T `change` for G, the features of :func:`_normal_sums` and extra_terms them others (n, terms)."""
    square, right = _normal_sums(gradient, u, v, np.concatenate([change, extra_terms], axis=1))
    light, across = right[:, : change.shape[1]], right[:, change.shape[1] :]
    return np.block([[square, across], [across.T, extra_terms.T @ extra_terms]]), np.concatenate(
        [light, extra_terms.T @ change]
    )


def _normal_sums(
    gradient: FloatArray, u: FloatArray, v: FloatArray, change: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """F^T F and F^T `change` (n, any) for F = features(gradient, u, v, *MAX_SIZE), without F: each of its 126 columns
    is a term of the normal times one of the place, and of the products of two columns most are the same powers. What is
    left are 87 products of the normal times 15 of the place, summed over CHUNK pixels at a time."""
    degree, position = MAX_SIZE
    normals, places = len(_normal_powers(degree)), len(_place_powers(position))
    sums = np.zeros((len(_normal_products()), len(_place_powers(2 * position))))
    channels = change.shape[1]
    right = np.zeros((normals, places * channels))
    for start in range(0, len(gradient), CHUNK_PIXELS):
        part = slice(start, start + CHUNK_PIXELS)
        normal = normal_terms(gradient[part], 2 * degree)
        normal = np.concatenate([normal, normal[2] * normal[:normals]])  # as _products has them
        place = position_terms(u[part], v[part], 2 * position)
        sums += normal @ place.T
        right += normal[:normals] @ (place[:places, None] * change[part].T).reshape(places * channels, -1).T
    of_normals, of_places = _product_indices()
    square = sums[of_normals[None, :, None, :], of_places[:, None, :, None]]  # (places, normals, places, normals)
    by_place = right.reshape(normals, places, channels).swapaxes(0, 1)
    return square.reshape(places * normals, -1), by_place.reshape(-1, channels)


def _normal_powers(degree: int) -> list[tuple[int, ...]]:
    """Powers of nx, ny and 1 - nz of the terms of the normal, in their order."""
    higher = [(order - b, b, 0) for order in range(2, degree + 1) for b in range(order + 1)]
    return [(1, 0, 0), (0, 1, 0), (0, 0, 1), *higher]


def _normal_products() -> list[tuple[int, ...]]:
    """The same of all products of two terms of the normal (and a few more): terms of twice the degree, and the terms
    times 1 - nz."""
    return [*_normal_powers(2 * MAX_SIZE[0]), *((a, b, c + 1) for a, b, c in _normal_powers(MAX_SIZE[0]))]


def _place_powers(position: int) -> list[tuple[int, ...]]:
    """Powers of u and v of the terms of the place."""
    return [(order - b, b) for order in range(position + 1) for b in range(order + 1)]


@functools.cache
def _product_indices() -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of the products of two terms: of the normal (n, n), and of the place (m, m)."""

    def where(powers: list[tuple[int, ...]], products: list[tuple[int, ...]]) -> NDArray[np.intp]:
        return np.array([[products.index(tuple(np.add(one, other))) for other in powers] for one in powers])

    degree, position = MAX_SIZE
    return where(_normal_powers(degree), _normal_products()), where(
        _place_powers(position), _place_powers(2 * position)
    )


def solve_weights(pixels: NormalEquations, size: ModelSize) -> FloatArray:
    """(terms, 3) ridge weights; `pixels`: the sum of all presses that count."""
    part = _select_terms(pixels, terms_of(size))
    return ridge_solution(part.square, part.right, size.ridge)


def ridge_solution(square: FloatArray, right: FloatArray, ridge: float) -> FloatArray:
    """(terms, 3) solution of the normal equations (1 or 3, terms, terms), (terms, 3) with `ridge` times the mean
    diagonal added to the diagonal."""
    size = square.shape[-1]
    shift = np.maximum(ridge * np.trace(square, axis1=1, axis2=2) / size, 1e-300)
    regular = square + shift[:, None, None] * np.eye(size)
    if len(square) == 1:
        return np.asarray(np.linalg.solve(regular[0], right), dtype=np.float64)
    return np.asarray(np.linalg.solve(regular, right.T[..., None])[..., 0].T, dtype=np.float64)


def left_out_error(presses: Sequence[NormalEquations], ridge: float) -> float:
    """Root mean square error of each press predicted from all others [relative change of colour]."""
    every = functools.reduce(operator.add, presses)
    error = 0.0
    for press in presses:
        others = every - press
        weights = ridge_solution(others.square, others.right, ridge)
        own, wanted = press.square, press.right
        seen = own @ weights if len(own) == 1 else own @ weights.T[..., None]  # (1, terms, 3) or (3, terms, 1)
        seen = seen[0] if len(own) == 1 else seen[..., 0].T
        error += press.power - 2 * float((weights * wanted).sum()) + float((weights * seen).sum())
    return float(np.sqrt(max(error, 0.0) / every.count))


def choose_size(presses: Sequence[NormalEquations]) -> ModelSize:
    """The size of the model. Up to MAX_FEW_PRESSES: a cubic that is the same everywhere. With more: the smallest model
    for which no larger one predicts left-out presses clearly better, each with its best ridge. Cast shadows, if they
    are among the terms, are added if they improve it by a large factor; then depth, and then slopes at depth, if they
    improve it."""
    ridge_of_few_presses = 1e-3
    if len(presses) <= tuning.MAX_FEW_PRESSES:
        return ModelSize(3, 0, ridge_of_few_presses)
    error, size = _best_size(presses, 0)
    extra_terms = len(presses[0].right) - term_count(*MAX_SIZE)
    shadows = max(extra_terms - DEPTH_TERMS - SLOPE_TERMS, 0)
    if shadows:
        other_error, other = _best_size(presses, shadows)
        if other_error < tuning.MIN_SHADOW_IMPROVEMENT * error:
            error, size = other_error, other
    if not extra_terms:
        return size
    deep_error, deep = _best_ridge(presses, replace(size, depth=DEPTH_TERMS))
    other_error, other = _best_ridge(presses, replace(deep, slopes=term_count(size.degree, 0)))
    if other_error < tuning.MIN_SLOPES_IMPROVEMENT * min(deep_error, tuning.MIN_DEPTH_IMPROVEMENT * error):
        return other
    return deep if deep_error < tuning.MIN_DEPTH_IMPROVEMENT * error else size


def _best_size(presses: Sequence[NormalEquations], shadows: int) -> tuple[float, ModelSize]:
    """The left-out error of the best size with this number of terms of shadows, and that size."""
    # degree in the normal, in the place
    sizes = ((1, 0), (3, 0), (5, 0), (1, 1), (3, 1), (5, 1), (1, 2), (3, 2), (5, 2))
    best: tuple[float, ModelSize] | None = None
    for degree, position in sorted(sizes, key=lambda size: term_count(*size)):
        error, size = _best_ridge(presses, ModelSize(degree, position, RIDGES[0], shadows=shadows))
        if best is None or error < tuning.MIN_SIZE_IMPROVEMENT * best[0]:
            best = (error, size)
    assert best is not None
    return best


def _best_ridge(presses: Sequence[NormalEquations], size: ModelSize) -> tuple[float, ModelSize]:
    """The left-out error of a size with its best ridge, and that size."""
    use = terms_of(size)
    parts = [_select_terms(press, use) for press in presses]
    error, ridge = min((left_out_error(parts, ridge), ridge) for ridge in RIDGES)
    return error, replace(size, ridge=ridge)


def _select_terms(of: NormalEquations, use: list[int]) -> NormalEquations:
    """The equations of some of the terms."""
    return NormalEquations(of.square[:, use][:, :, use], of.right[use], of.power, of.count)


def terms_of(size: ModelSize) -> list[int]:
    """Indices of the terms of `size` among all terms."""
    normals, all_normals = term_count(size.degree, 0), term_count(MAX_SIZE[0], 0)
    places = term_count(1, size.position) // term_count(1, 0)
    deep = term_count(*MAX_SIZE)
    slopes = deep + DEPTH_TERMS
    dark = slopes + SLOPE_TERMS
    return [
        *(place * all_normals + term for place in range(places) for term in range(normals)),
        *range(deep, deep + size.depth),
        *range(slopes, slopes + size.slopes),
        *range(dark, dark + size.shadows),
    ]
