"""Weights of a photometric model from labelled presses, and how well they hold for presses that were left out.

Every press keeps only its normal equations. So any number of presses, orders and left-out presses costs one look at
the pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacsim.optics.photometric import normal_terms, position_terms, term_count

Float64 = NDArray[np.float64]

LARGEST = (5, 2)  # degree in the normal, degree in the place: the most that is tried
ORDERS = ((1, 0), (3, 0), (5, 0), (1, 1), (3, 1), (5, 1), (1, 2), (3, 2), (5, 2))  # by number of weights, nearly
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3)  # times the mean of the diagonal of the normal equations
FEW = 3  # presses up to this number cover too little of the image to know how its light varies
FEW_RIDGE = 1e-3
WORTH = 0.98  # a larger model must lower the left-out error to this


@dataclass(frozen=True, slots=True)
class Order:
    """Size of a photometric model."""

    degree: int
    position: int
    ridge: float

    @property
    def terms(self) -> int:
        return term_count(self.degree, self.position)


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """Normal equations of one press for the terms of LARGEST. Each channel has its own where pixels are saturated in
    one and not in another."""

    square: Float64  # (1, terms, terms) of all channels, or (3, terms, terms)
    right: Float64  # (terms, 3)
    power: float  # sum of the squares of the changes of colour
    count: int  # numbers summed


def features(gradient: Float64, u: Float64, v: Float64, degree: int, position: int) -> Float64:
    """(n, terms) for slopes (n, 2) at places u, v (n,) in -1/2..1/2."""
    normal = np.stack(normal_terms(gradient, degree), axis=-1)
    place = np.stack(position_terms(u, v, position), axis=-1)
    return (place[:, :, None] * normal[:, None, :]).reshape(len(gradient), -1)


def equations(
    gradient: Float64, u: Float64, v: Float64, change: Float64, lit: NDArray[np.bool_] | None = None
) -> Equations:
    """Of n pixels: slopes (n, 2), places (n,), relative changes of colour (n, 3); `lit` (n, 3): what is not saturated,
    and counts; None: all."""
    terms = features(gradient, u, v, *LARGEST)
    square = terms.T @ terms
    if lit is None or lit.all():
        return Equations(square[None], terms.T @ change, float((change**2).sum()), change.size)
    burnt = [terms[~lit[:, channel]] for channel in range(3)]
    counted = change * lit
    squares = np.stack([square - lost.T @ lost for lost in burnt])
    return Equations(squares, terms.T @ counted, float((counted**2).sum()), int(lit.sum()))


def solve(presses: Sequence[Equations], order: Order) -> Float64:
    """(terms, 3) ridge weights."""
    use = _terms_of(order)
    square = sum((_part(p, use) for p in presses), np.zeros((1, len(use), len(use))))
    right = sum((p.right[use] for p in presses), np.zeros((len(use), 3)))
    return ridge_solution(square, right, order.ridge)


def ridge_solution(square: Float64, right: Float64, ridge: float) -> Float64:
    """(terms, 3) solution of the normal equations (1 or 3, terms, terms), (terms, 3) with `ridge` times the mean
    diagonal added to the diagonal."""
    size = square.shape[-1]
    shift = np.maximum(ridge * np.trace(square, axis1=1, axis2=2) / size, 1e-300)
    regular = square + shift[:, None, None] * np.eye(size)
    if len(square) == 1:
        return np.asarray(np.linalg.solve(regular[0], right), dtype=np.float64)
    return np.asarray(np.linalg.solve(regular, right.T[..., None])[..., 0].T, dtype=np.float64)


def left_out_error(presses: Sequence[Equations], order: Order) -> float:
    """Root mean square error of each press predicted from all others [relative change of colour]."""
    use = _terms_of(order)
    square = sum((_part(p, use) for p in presses), np.zeros((1, len(use), len(use))))
    right = sum((p.right[use] for p in presses), np.zeros((len(use), 3)))
    error, count = 0.0, 0
    for press in presses:
        own, wanted = _part(press, use), press.right[use]
        weights = ridge_solution(square - own, right - wanted, order.ridge)
        seen = own @ weights if len(own) == 1 else own @ weights.T[..., None]  # (1, terms, 3) or (3, terms, 1)
        seen = seen[0] if len(own) == 1 else seen[..., 0].T
        error += press.power - 2 * float((weights * wanted).sum()) + float((weights * seen).sum())
        count += press.count
    return float(np.sqrt(max(error, 0.0) / count))


def choose_order(presses: Sequence[Equations]) -> Order:
    """The size of model that the number of presses carries and left-out presses speak for.

    Up to FEW presses: a cubic that is the same everywhere. With more, the smallest model that no larger one betters by
    more than a little, each with its best ridge.
    """
    if len(presses) <= FEW:
        return Order(3, 0, FEW_RIDGE)
    best: tuple[float, Order] | None = None
    for degree, position in sorted(ORDERS, key=lambda order: term_count(*order)):
        tried = [(left_out_error(presses, order), order) for order in (Order(degree, position, r) for r in RIDGES)]
        error, order = min(tried, key=lambda pair: pair[0])
        if best is None or error < WORTH * best[0]:
            best = (error, order)
    assert best is not None
    return best[1]


def _part(press: Equations, use: list[int]) -> Float64:
    return press.square[:, use][:, :, use]


def _terms_of(order: Order) -> list[int]:
    """Where the terms of `order` stand among those of LARGEST."""
    normals, all_normals = term_count(order.degree, 0), term_count(LARGEST[0], 0)
    places = term_count(1, order.position) // term_count(1, 0)
    return [place * all_normals + term for place in range(places) for term in range(normals)]
