"""Figures of something that is done several times: the median of what is measured, the sum of what is counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.harness.measure import Measurement, Timing

COUNT = "count"  # the unit of what should not happen even once
AGAIN = 3  # times that a disturbed repetition is made up for, in all


class Disturbed(RuntimeError):
    """Something happened that the case did not cause: its figures would say nothing."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of a case: its variant, unit, and what it is measured against."""

    variant: str
    unit: str
    against: str


def repeated(repeat: int, once: Callable[[], Mapping[str, float]], figures: Sequence[Figure]) -> list[Measurement]:
    """Does `once` `repeat` times; it gives a value for every figure, by variant.

    Seconds are those of one repetition, everything that prepares it included. Of the figures stand beside the median:
    the worst repetition and the interquartile range, both in the figure's unit. A disturbed repetition is done again,
    and told in the note. Raises Disturbed when that happens too often.
    """
    found: list[Mapping[str, float]] = []
    samples, processor, disturbed = [], [], []
    while len(found) < repeat:
        wall, cpu = time.perf_counter(), time.process_time()
        try:
            found.append(once())
        except Disturbed as reason:
            disturbed.append(str(reason))
            if len(disturbed) > AGAIN:
                raise
            continue
        samples.append(time.perf_counter() - wall)
        processor.append(time.process_time() - cpu)
    timing = Timing(tuple(samples), float(np.median(processor)))
    note = f"{len(disturbed)} repetitions were disturbed and done again: {disturbed[-1]}" if disturbed else ""
    return [_row(timing, figure, [float(values[figure.variant]) for values in found], note) for figure in figures]


def _row(timing: Timing, figure: Figure, values: Sequence[float], note: str) -> Measurement:
    unit = {"%": "percent", "µs": "us"}.get(figure.unit, figure.unit)
    if figure.unit == COUNT:
        return Measurement(timing, float(np.sum(values)), figure.unit, figure.against, figure.variant, note=note)
    further = {f"worst_{unit}": max(values)}
    if len(values) > 2:
        low, high = np.percentile(values, [25, 75])
        further[f"spread_{unit}"] = float(high - low)
    error = float(np.median(values))
    return Measurement(timing, error, figure.unit, figure.against, figure.variant, figures=further, note=note)
