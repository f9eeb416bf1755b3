"""Depth -> colour of a light that tells no direction: a translucent skin that darkens where it is pressed in.

A picture of such a sensor tells depth itself, not slopes. What counts is the depth of a point beyond a share of the
mean depth round it,

    y = h - share * (Gaussian mean of h, standard deviation `reach`),

because a dent throws light back on the gel beside it: real pictures are brighter round a contact than without one. The
relative change of colour (I - I0) / mean(I0) is a monotone table of y, the same everywhere. With `share` 0 each pixel
stands for itself.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator

from tacsim.models.quantity import Config, Length

Change = Annotated[float, Field(allow_inf_nan=False)]


class DarknessModel(Config):
    """The model of one sensor's light, both ways: the table is monotone."""

    depths: Annotated[tuple[Length, ...], Field(min_length=2, max_length=256)]  # y, rising; below 0 beside a dent [m]
    changes: tuple[tuple[Change, Change, Change], ...]  # of R, G, B at each depth; their mean falls
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
