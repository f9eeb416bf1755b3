"""What differs from episode to episode, drawn from distributions."""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Sequence
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from tacsim.models.quantity import Config

Number = float | str  # bare, or a text with its unit ("5 mm")
Entry = Number | tuple[Number, ...]  # of a list each element is drawn by itself
_NUMBER = re.compile(r"\s*([-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s*([^\s0-9.]\S*)?\s*")


class Distribution(Config):
    """One of `uniform`, `log_uniform` (both [least, greatest]), `normal` ([mean, standard deviation], with bounds that
    it keeps `within`), or `choice` (all equally likely)."""

    uniform: tuple[Entry, Entry] | None = None
    log_uniform: tuple[Entry, Entry] | None = None
    normal: tuple[Entry, Entry] | None = None
    within: tuple[Entry, Entry] | None = None
    choice: Annotated[tuple[Entry, ...], Field(min_length=1, max_length=10_000)] | None = None

    @model_validator(mode="after")
    def _require_one_distribution(self) -> Self:
        given = [k for k in ("uniform", "log_uniform", "normal", "choice") if getattr(self, k) is not None]
        if len(given) != 1:
            raise ValueError(
                f"give one of uniform, log_uniform, normal and choice, got {' and '.join(given) or 'none'}"
            )
        if (self.normal is None) != (self.within is None):
            raise ValueError(
                "a normal distribution needs bounds, and only that: normal: [mean, deviation] with within: [a, b]"
            )
        if self.choice is None:
            for elements in self._elements():
                _require_drawable(elements, given[0])
        return self

    def draw(self, random: np.random.Generator) -> str:
        """As a YAML text."""
        if self.choice is not None:
            return _entry_text(self.choice[int(random.integers(len(self.choice)))])
        drawn = [_draw_elements(elements, self, random) for elements in self._elements()]
        first = (self.uniform or self.log_uniform or self.normal or ((),))[0]
        return f"[{', '.join(drawn)}]" if isinstance(first, tuple) else drawn[0]

    def ends(self) -> list[str]:
        """The least and the greatest that can be drawn, as YAML texts; none of a choice."""
        return [_entry_text(end) for end in self.within or self.uniform or self.log_uniform or ()]

    def _elements(self) -> list[tuple[tuple[float, ...], str]]:
        """For each element its numbers (two; of a normal four: mean, deviation, bounds), and their unit."""
        ends = [*(self.uniform or self.log_uniform or self.normal or ()), *(self.within or ())]
        columns = [end if isinstance(end, tuple) else (end,) for end in ends]
        if len({len(column) for column in columns}) > 1 or len({isinstance(end, tuple) for end in ends}) > 1:
            raise ValueError(f"all of {', '.join(map(_entry_text, ends))} must be numbers, or lists of one length")
        return [_sort_numbers(row) for row in zip(*columns, strict=True)]


class Randomisation(Config):
    """A number of scenes and tasks; each episode plays one of them. A value is named as on the command line:
    ``scene.body.material.yield_stress``."""

    draws: Annotated[int, Field(ge=1, le=10_000)] = 64
    seed: Annotated[int, Field(ge=0)] = 0
    values: Annotated[dict[str, Distribution], Field(min_length=1, max_length=100)]

    def draw_overrides(self) -> list[list[str]]:
        """Overrides ``key=value``, one list for each draw. What is drawn for one key does not depend on the others, nor
        on how many are drawn."""
        return [
            [
                f"{key}={each.draw(np.random.default_rng([self.seed, number, zlib.crc32(key.encode())]))}"
                for key, each in self.values.items()
            ]
            for number in range(self.draws)
        ]

    def limits(self) -> list[list[str]]:
        """Overrides like those of `draw_overrides`: the first draw with one value at an end of its range, for each
        value with ends. Other seeds may draw what lies near."""
        first = self.draw_overrides()[0]
        return [
            [*first[:at], f"{key}={end}", *first[at + 1 :]]
            for at, (key, each) in enumerate(self.values.items())
            for end in each.ends()
        ]


def _sort_numbers(row: Sequence[Number]) -> tuple[tuple[float, ...], str]:
    found = []
    for number in row:
        match = _NUMBER.fullmatch(str(number))
        if match is None or not math.isfinite(float(match[1])):
            raise ValueError(f"{number!r} is no number; allowed: a number, or a text with its unit such as '5 mm'")
        found.append((float(match[1]), match[2] or ""))
    units = {unit for _, unit in found}
    if len(units) > 1:
        raise ValueError(f"{', '.join(map(str, row))}: give all in one unit")
    return tuple(number for number, _ in found), units.pop()


def _require_drawable(elements: tuple[tuple[float, ...], str], kind: str) -> None:
    numbers, _ = elements
    least, greatest = numbers[-2:]
    if not least <= greatest:
        raise ValueError(f"[{least:g}, {greatest:g}]: the least comes first, then the greatest")
    if kind == "log_uniform" and not least > 0:
        raise ValueError(f"log_uniform from {least:g}: its bounds must be positive")
    if kind == "normal":
        mean, deviation = numbers[:2]
        if not deviation > 0:
            raise ValueError(f"a standard deviation of {deviation:g}: it must be positive")
        if not least <= mean <= greatest:
            raise ValueError(f"mean {mean:g} is not within [{least:g}, {greatest:g}]")


def _draw_elements(elements: tuple[tuple[float, ...], str], kind: Distribution, random: np.random.Generator) -> str:
    max_draws = 1000  # draws of a normal until one is within its bounds
    numbers, unit = elements
    least, greatest = numbers[-2:]
    if kind.log_uniform is not None:
        value = math.exp(random.uniform(math.log(least), math.log(greatest)))
    elif kind.uniform is not None:
        value = random.uniform(least, greatest)
    else:
        mean, deviation = numbers[:2]
        tries = random.normal(mean, deviation, max_draws)
        inside = tries[(tries >= least) & (tries <= greatest)]
        # Bounds that are this narrow cut a piece out of the bell that is flat.
        value = float(inside[0]) if len(inside) else random.uniform(least, greatest)
    return f"{value:.9g} {unit}".strip()


def _entry_text(entry: Entry | Any) -> str:
    return f"[{', '.join(map(str, entry))}]" if isinstance(entry, tuple) else str(entry)
