"""Figures of something that is done several times: the median of what is measured, the sum of what is counted."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from robot.bench.measure import Measurement, Timing

COUNT = "count"  # the unit of what should not happen even once


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of a case: its variant, unit, and what it is measured against."""

    variant: str
    unit: str
    against: str


def repeated(repeat: int, once: Callable[[], Mapping[str, float]], figures: Sequence[Figure]) -> list[Measurement]:
    """Does `once` `repeat` times; it gives a value for every figure, by variant.

    Seconds are those of one repetition, everything that prepares it included. Of the figures stand beside the median:
    the worst repetition and the interquartile range, both in the figure's unit.
    """
    found, samples, processor = [], [], []
    for _ in range(repeat):
        wall, cpu = time.perf_counter(), time.process_time()
        found.append(once())
        samples.append(time.perf_counter() - wall)
        processor.append(time.process_time() - cpu)
    timing = Timing(tuple(samples), float(np.median(processor)))
    return [_row(timing, figure, [float(values[figure.variant]) for values in found]) for figure in figures]


def _row(timing: Timing, figure: Figure, values: Sequence[float]) -> Measurement:
    unit = {"%": "percent", "µs": "us"}.get(figure.unit, figure.unit)
    if figure.unit == COUNT:
        return Measurement(timing, float(np.sum(values)), figure.unit, figure.against, figure.variant)
    further = {f"worst_{unit}": max(values)}
    if len(values) > 2:
        low, high = np.percentile(values, [25, 75])
        further[f"spread_{unit}"] = float(high - low)
    error = float(np.median(values))
    return Measurement(timing, error, figure.unit, figure.against, figure.variant, figures=further)
