"""Compares the observations of a learned policy with those of its training.

An observation is reduced to the numbers of its newest frame (of a map or a flow: mean, minimum and maximum of each
channel) and the products of each pair of them: the products show correlations, such as gap and depth of the gels. Their
distance from the mean of training, whitened by the covariance of training (Mahalanobis 1936), is compared with a limit
from episodes of the training: the split conformal quantile (Vovk et al. 2005) of the maximum distance of each episode,
over episodes that mean and covariance were not fitted to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray
from tacsim.models.policy import PolicySpec, TrainingRange
from tacsim.models.scene import Scene

MAX_FALSE_ALARMS = 0.03  # fraction of training episodes that may exceed the limit
ROUNDING = 1e-6  # of a scene's number, for rounding [fraction]
MIN_DEVIATION = 0.01  # of a number in training; a smaller one is replaced by it [encoded]
MIN_VARIANCE = 0.01  # of a direction, relative to 1 of a number; smaller ones are noise
PHYSICAL = (
    "gel",
    "gels",
    "body",
    "object",
    "fixtures",
    "friction",
    "gravity",
)  # parts of a scene that affect observations
QUASI_STATIC_IRRELEVANT = ("density", "seed")  # numbers without effect on quasi-static motions
BEFORE_GRIP = ("object.position", "object.pedestal", "object.lift")  # where an object stands until it is gripped
EncodedFeatures = Mapping[str, NDArray[Any]]


def extract_numbers(features: EncodedFeatures, frames: int) -> FloatArray:
    """Numbers (n,) of the newest of an observation's `frames`, in the order of `number_names`."""
    parts = []
    for key in sorted(features):
        values = np.asarray(features[key], np.float64)
        if key != "goal":
            values = values[-(len(values) // frames) :]
        if values.ndim == 1:
            parts.append(values)
        else:
            channels = values.reshape(len(values), -1)
            parts.append(np.stack([channels.mean(axis=1), channels.min(axis=1), channels.max(axis=1)], axis=1).ravel())
    return np.concatenate(parts)


def number_names(spec: PolicySpec, goals: int) -> list[str]:
    """Names of the numbers of `extract_numbers`. `goals`: count of goal numbers."""
    found: dict[str, list[str]] = {}
    for key, each in spec.inputs.items():
        newest = each.names[-(len(each.names) // spec.features.frames) :]
        if key == "touch":
            found[key] = list(newest)
        else:
            found[key] = [f"{name} {of}" for name in newest for of in ("mean", "minimum", "maximum")]
    if spec.features.goal:
        found["goal"] = [f"goal {at}" for at in range(goals)]
    return [name for key in sorted(found) for name in found[key]]


def append_products(numbers: FloatArray) -> FloatArray:
    """Appends the products of each pair to numbers (..., n), if n <= `max_numbers_with_products`: (..., m)."""
    max_numbers_with_products = 12  # with more numbers no products are added
    count = numbers.shape[-1]
    if count > max_numbers_with_products:
        return numbers
    first, second = np.triu_indices(count)
    return np.concatenate([numbers, numbers[..., first] * numbers[..., second]], axis=-1)


def fit_training_range(episodes: Sequence[FloatArray], scenes: Sequence[Scene]) -> TrainingRange:
    """The range of `episodes`, each (steps, n) numbers of `extract_numbers`, played in `scenes`.

    Mean and covariance come from every second episode, the limit from the others. Raises ValueError for fewer than two
    episodes.
    """
    if len(episodes) < 2:
        raise ValueError(f"{len(episodes)} episodes give no range: use at least two, better a hundred")
    whole = np.concatenate(list(episodes))
    fitted = append_products(np.concatenate(list(episodes[::2])))
    centre, own = fitted.mean(axis=0), fitted.std(axis=0)
    deviation = np.maximum(own, MIN_DEVIATION)
    covariance = np.atleast_2d(np.cov((fitted - centre) / deviation, rowvar=False))
    variance, directions = np.linalg.eigh(covariance + np.diag(1.0 - (own / deviation) ** 2))
    scale = np.sqrt(np.maximum(variance, MIN_VARIANCE) * len(variance))
    axes = (directions / scale) @ directions.T / deviation  # symmetric, so the order of equal directions has no effect
    largest = np.sort([mahalanobis_distances(each, centre, axes).max() for each in episodes[1::2]])
    at = min(int(np.ceil((len(largest) + 1) * (1 - MAX_FALSE_ALARMS))), len(largest)) - 1
    numbers, words = scene_ranges(scenes)
    return TrainingRange(
        episodes=len(episodes),
        low=_rounded(whole.min(axis=0)),
        high=_rounded(whole.max(axis=0)),
        centre=_rounded(centre),
        axes=tuple(_rounded(axis) for axis in axes),
        limit=_rounded(largest[at : at + 1])[0],
        scene=numbers,
        words=words,
    )


def mahalanobis_distances(numbers: FloatArray, centre: FloatArray, axes: FloatArray) -> FloatArray:
    """Distances (...,) of observations (..., n): RMS over the whitened directions; about 1 in training."""
    found: FloatArray = np.linalg.norm((append_products(numbers) - centre) @ axes.T, axis=-1)
    return found


def _rounded(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(f"{value:.6g}") for value in values.tolist())


class RangeMonitor:
    """Compares the observations of an episode with the training range of a policy.

    Args:
        known: the range; None: unknown.
        names: of the numbers of an observation; empty: without names.

    Raises ValueError if the range has other numbers.
    """

    def __init__(self, known: TrainingRange | None, names: Sequence[str] = (), frames: int = 1) -> None:
        self.known, self._names, self._frames = known, tuple(names), frames
        if known is not None:
            expected = append_products(np.zeros(len(names))).shape if names else (len(known.centre),)
            if (len(known.centre),) != expected or (names and len(known.low) != len(names)):
                raise ValueError(
                    f"the training range has {len(known.low)} numbers ({len(known.centre)} with products), the "
                    f"policy has {len(names)}: measure it again with tacsim export policy-range"
                )
            self._centre, self._axes = np.array(known.centre), np.array(known.axes)
            self._low, self._high = np.array(known.low), np.array(known.high)
        self.reset()

    def reset(self) -> None:
        """Begins a new episode."""
        self.largest = 0.0  # maximum of distance / limit in the episode
        self.latest = 0.0  # distance / limit of the last observation
        self._worst: FloatArray | None = None  # numbers of the observation with the maximum distance

    def __call__(self, features: EncodedFeatures) -> None:
        """Adds the next observation."""
        if self.known is None:
            return
        numbers = extract_numbers(features, self._frames)
        self.latest = float(mahalanobis_distances(numbers, self._centre, self._axes)) / self.known.limit
        if self.latest > self.largest:
            self.largest, self._worst = self.latest, numbers

    @property
    def is_outside(self) -> bool:
        """True if an observation of this episode is outside the range of training."""
        return self.largest > 1.0

    def describe_outside(self) -> str:
        """Text on the farthest observation, with its number that is farthest outside its own range."""
        text = f"its observations leave the range of its training (distance {self.largest:.1f} times the limit)"
        assert self.known is not None and self._worst is not None
        width = np.maximum(self._high - self._low, MIN_DEVIATION)
        excess = np.maximum(self._low - self._worst, self._worst - self._high) / width
        at = int(np.argmax(excess))
        if excess[at] <= 0.0 or at >= len(self._names):
            return f"{text}: each number is within its range, their combination is not"
        return (
            f"{text}: {self._names[at]} is {self._worst[at]:.3g}, in training {self._low[at]:.3g} to "
            f"{self._high[at]:.3g} (encoded)"
        )


def scene_numbers(scene: Scene) -> dict[str, float | str]:
    """Parameters of a scene that affect observations: each number of its gels, body or object, friction and gravity
    [SI], and its shape, by its key in the scene file. A parameter that is not given has no key."""
    found: dict[str, float | str] = {}

    def walk(key: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for name, each in value.items():
                walk(f"{key}.{name}", each)
        elif key.rpartition(".")[2] in QUASI_STATIC_IRRELEVANT or key in BEFORE_GRIP or isinstance(value, bool):
            return
        elif isinstance(value, Sequence) and not isinstance(value, str):
            for at, each in enumerate(value):
                walk(f"{key}[{at}]", each)
        elif isinstance(value, int | float):
            found[key] = float(value)
        elif key.endswith(".shape"):
            found[key] = str(value)

    whole = scene.model_dump(mode="json")
    for part in PHYSICAL:
        if whole.get(part) is not None:
            walk(part, whole[part])
    return found


def scene_ranges(scenes: Sequence[Scene]) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[str, ...]]]:
    """Minimum and maximum of each number of the `scenes`, and their words (shapes)."""
    numbers: dict[str, tuple[float, float]] = {}
    words: dict[str, tuple[str, ...]] = {}
    for scene in scenes:
        for key, value in scene_numbers(scene).items():
            if isinstance(value, str):
                words[key] = tuple(sorted({*words.get(key, ()), value}))
            else:
                low, high = numbers.get(key, (value, value))
                numbers[key] = (min(low, value), max(high, value))
    return numbers, words


def describe_scenes_outside(known: TrainingRange, scenes: Sequence[Scene]) -> list[str]:
    """Texts on the parameters of simulated `scenes` outside those of the training scenes; empty if all are within."""
    here, words = scene_ranges(scenes)
    found = []
    for key, (low, high) in here.items():
        trained = known.scene.get(key)
        if trained is None:
            found.append(f"{key} is {_interval(low, high)}, in training it was not given")
        elif low < trained[0] - ROUNDING * abs(trained[0]) or high > trained[1] + ROUNDING * abs(trained[1]):
            found.append(f"{key} is {_interval(low, high)}, in training {_interval(*trained)}")
    for key, given in words.items():
        new = sorted(set(given) - set(known.words.get(key, ())))
        if new:
            found.append(f"{key} is {', '.join(new)}, in training {', '.join(known.words.get(key, ())) or 'none'}")
    missing = sorted(set(known.scene) - set(here)) if scenes else []
    return found + [f"{key} is not given, in training {_interval(*known.scene[key])}" for key in missing]


def _interval(low: float, high: float) -> str:
    return f"{low:g}" if high - low <= ROUNDING * abs(high) else f"{low:g} to {high:g}"
