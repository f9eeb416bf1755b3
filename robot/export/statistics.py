"""Statistics of a data set's columns, as LeRobot keeps them: min, max, mean, std, count and five quantiles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Statistics = dict[str, NDArray[Any]]

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}


class ImageCounts:
    """How often each value occurs in the pictures of an episode, by channel: all statistics follow, exactly."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), np.int64)
        self._pictures = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """(H, W, 3)."""
        self._pictures += 1
        for channel in range(3):
            self._counts[channel] += np.bincount(image[..., channel].ravel(), minlength=256)

    def statistics(self) -> Statistics:
        """(3, 1, 1) each, of values / 255; `count` of pictures, (1,)."""
        values = np.arange(256) / 255.0
        total = self._counts.sum(axis=1)
        mean = self._counts @ values / total
        found = {
            "min": values[(self._counts > 0).argmax(axis=1)],
            "max": values[255 - (self._counts[:, ::-1] > 0).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt((self._counts * (values - mean[:, None]) ** 2).sum(axis=1) / total),
        }
        below = self._counts.cumsum(axis=1)
        for name, share in QUANTILES.items():  # the least value with at least this share at or below it
            found[name] = values[(below >= share * total[:, None]).argmax(axis=1)]
        return {name: each.reshape(3, 1, 1) for name, each in found.items()} | {"count": np.array([self._pictures])}


def column_statistics(values: NDArray[Any]) -> Statistics:
    """Of the (frames, ...) of an episode: each number by itself; of a map (frames, h, w[, 2]) one for all its cells, in
    a shape that spreads over the map."""
    numbers = values.astype(np.float64)
    over = (0,) if values.ndim <= 2 else (0, 1, 2)

    def shaped(found: Any) -> NDArray[Any]:
        return np.asarray(found).reshape(values.shape[1:] if len(over) == 1 else (1, 1, *values.shape[3:]))

    found = {
        "min": shaped(numbers.min(axis=over)),
        "max": shaped(numbers.max(axis=over)),
        "mean": shaped(numbers.mean(axis=over)),
        "std": shaped(numbers.std(axis=over)),
        "count": np.array([len(values)]),
    }
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=over)
    return found | {name: shaped(each) for name, each in zip(QUANTILES, quantiles, strict=True)}


def merged(each: Sequence[Statistics]) -> Statistics:
    """Of several episodes together, as LeRobot merges them: exact but for the quantiles, which are means of the
    episodes', weighted by their frames."""
    counts = np.array([float(found["count"][0]) for found in each])

    def mean(name: str) -> NDArray[Any]:
        return np.asarray(np.tensordot(counts, np.stack([found[name] for found in each]), axes=1) / counts.sum())

    total = mean("mean")
    spread = np.stack([found["std"] ** 2 + (found["mean"] - total) ** 2 for found in each])
    whole = {
        "min": np.min([found["min"] for found in each], axis=0),
        "max": np.max([found["max"] for found in each], axis=0),
        "mean": total,
        "std": np.sqrt(np.tensordot(counts, spread, axes=1) / counts.sum()),
        "count": np.array([int(counts.sum())]),
    }
    return whole | {name: mean(name) for name in QUANTILES}
