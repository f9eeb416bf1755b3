"""Cast shadows: what a dent hides from lamps that stand low beside the gel, as in a DIGIT.

To the camera a dent is a bump. A place of the surface lies in its shade where the way to the lamp is steep:

    horizon = max over STEPS s of (h(x + s e) - h(x)) / s,    e = direction from the place x to the lamp,

with the height h into the gel. The relative change of colour is, in each channel, the sum

    over lamps, over SLOPES, over position terms 1, u, v of weight * ramp,

where `ramp` goes from 0 to 1 as the horizon goes from that slope to WIDTH times it. Neither the height of a lamp nor
its size is assumed: the weights say at which horizons it gets dark, how dark, in which colour, and where.

Lengths are in widths of the picture, places from its middle, x right, y down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from tacsim.models.quantity import Config

Floats = NDArray[np.floating]

SLOPES = (0.1, 0.3, 0.75)  # horizons at which it begins to get dark [-]
WIDTH = 1.5
STEPS = tuple(0.012 * 1.3**k for k in range(14))  # from 1/80 to a third of the picture
PLACES = 3  # position terms: 1, u, v
NEAR = 1e-3  # so near to a lamp its direction is not told apart

Number = Annotated[float, Field(allow_inf_nan=False)]


class CastShadows(Config):
    """The shadows of one sensor."""

    lamps: Annotated[
        tuple[tuple[Number, Number], ...], Field(min_length=1, max_length=8)
    ]  # x, y in the picture's plane
    weights: tuple[tuple[Number, Number, Number], ...]  # of R, G, B; rows by lamp, then by slope, then by position term

    @model_validator(mode="after")
    def _one_weight_a_term(self) -> Self:
        wanted = len(self.lamps) * len(SLOPES) * PLACES
        if len(self.weights) != wanted:
            raise ValueError(f"weights has {len(self.weights)} rows; shadows of {len(self.lamps)} lamps have {wanted}")
        return self


def horizon(height: Callable[[Floats, Floats], Floats], x: Floats, y: Floats, lamp: tuple[float, float]) -> Floats:
    """(...,) steepest way up towards the lamp from places x, y (...,), at least 0; `height` of places."""
    to_x, to_y = lamp[0] - x, lamp[1] - y
    distance = np.sqrt(to_x * to_x + to_y * to_y) + x.dtype.type(NEAR)
    to_x, to_y = to_x / distance, to_y / distance
    here = height(x, y)
    steepest = np.zeros_like(here)
    for step in map(x.dtype.type, STEPS):
        np.maximum(steepest, (height(x + step * to_x, y + step * to_y) - here) / step, out=steepest)
    return steepest


def shadow_terms(horizons: Sequence[Floats], u: Floats, v: Floats) -> Floats:
    """(terms, ...) for the horizons (...,) of each lamp at places u, v (...,) in -1/2..1/2 across the picture, in the
    order of the weights."""
    places = (np.ones_like(u), u, v)
    ramps = [
        np.clip((towards - slope) / ((WIDTH - 1) * slope), 0.0, 1.0).astype(u.dtype)
        for towards in horizons
        for slope in SLOPES
    ]
    return np.stack([ramp * place for ramp in ramps for place in places])
