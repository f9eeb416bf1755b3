"""Whether what a learned policy observes is what it observed in training.

Of the newest frame of each observation the numbers that the policy sees are taken (of a map or a flow, for each
channel its mean, least and greatest), with the products of each pair of them: what belongs together, as the gap and
the depth of the gels, shows in the products. Their distance from the mean of training, whitened by training's
covariance (Mahalanobis 1936), is compared with a limit that training's own episodes keep: the split conformal quantile
(Vovk et al. 2005) of each episode's largest distance, in episodes that mean and covariance were not fitted to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robot.deploy.tuning import MAX_FALSE_ALARMS, MIN_DEVIATION, MIN_VARIANCE, ROUNDING
from tacsim.interface import FloatArray
from tacsim.models.policy import PolicySpec, TrainingRange
from tacsim.models.scene import Scene

PHYSICAL = ("gel", "gels", "body", "friction", "gravity")  # parts of a scene that a policy feels
NOT_FELT = ("density", "seed")  # numbers in them that quasi-static motions do not depend on
Seen = Mapping[str, NDArray[Any]]


def numbers_of(seen: Seen, frames: int) -> FloatArray:
    """(n,) the numbers of the newest of an observation's `frames`, in the order of `names_of`."""
    parts = []
    for key in sorted(seen):
        values = np.asarray(seen[key], np.float64)
        if key != "goal":
            values = values[-(len(values) // frames) :]
        if values.ndim == 1:
            parts.append(values)
        else:
            channels = values.reshape(len(values), -1)
            parts.append(np.stack([channels.mean(axis=1), channels.min(axis=1), channels.max(axis=1)], axis=1).ravel())
    return np.concatenate(parts)


def names_of(spec: PolicySpec, goals: int) -> list[str]:
    """Of the numbers of `numbers_of`; `goals`: numbers of the goal."""
    found: dict[str, list[str]] = {}
    for key, each in spec.inputs.items():
        newest = each.names[-(len(each.names) // spec.features.frames) :]
        if key == "touch":
            found[key] = list(newest)
        else:
            found[key] = [f"{name} {of}" for name in newest for of in ("mean", "least", "greatest")]
    if spec.features.goal:
        found["goal"] = [f"goal {at}" for at in range(goals)]
    return [name for key in sorted(found) for name in found[key]]


def lifted(numbers: FloatArray) -> FloatArray:
    """(..., m) numbers (..., n), and after them, of up to MAX_PAIRED, the products of each pair."""
    max_paired = 12  # numbers of which the products count, too
    count = numbers.shape[-1]
    if count > max_paired:
        return numbers
    first, second = np.triu_indices(count)
    return np.concatenate([numbers, numbers[..., first] * numbers[..., second]], axis=-1)


def measured(episodes: Sequence[FloatArray], scenes: Sequence[Scene]) -> TrainingRange:
    """The range of `episodes`, each (steps, n) numbers as `numbers_of` gives, which were played in `scenes`.

    Mean and covariance are those of every other episode; the others give the limit. Raises ValueError for fewer than
    two episodes.
    """
    if len(episodes) < 2:
        raise ValueError(f"{len(episodes)} episodes say no range: take two at least, better a hundred")
    whole = np.concatenate(list(episodes))
    fitted = lifted(np.concatenate(list(episodes[::2])))
    centre, own = fitted.mean(axis=0), fitted.std(axis=0)
    deviation = np.maximum(own, MIN_DEVIATION)
    covariance = np.atleast_2d(np.cov((fitted - centre) / deviation, rowvar=False))
    variance, directions = np.linalg.eigh(covariance + np.diag(1.0 - (own / deviation) ** 2))
    scale = np.sqrt(np.maximum(variance, MIN_VARIANCE) * len(variance))
    axes = (directions / scale) @ directions.T / deviation  # symmetric, so that no choice among equal directions shows
    largest = np.sort([distances(each, centre, axes).max() for each in episodes[1::2]])
    at = min(int(np.ceil((len(largest) + 1) * (1 - MAX_FALSE_ALARMS))), len(largest)) - 1
    numbers, words = ranges_of(scenes)
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


def distances(numbers: FloatArray, centre: FloatArray, axes: FloatArray) -> FloatArray:
    """(...,) of observations (..., n): root mean square over the whitened directions; about 1 in training."""
    found: FloatArray = np.linalg.norm((lifted(numbers) - centre) @ axes.T, axis=-1)
    return found


def _rounded(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(f"{value:.6g}") for value in values.tolist())


class RangeWatch:
    """Compares what a policy observes in an episode with the range of its training.

    Args:
        known: None where it is unknown.
        names: of the numbers of an observation; empty: they are not named.

    Raises ValueError for a range of other numbers.
    """

    def __init__(self, known: TrainingRange | None, names: Sequence[str] = (), frames: int = 1) -> None:
        self.known, self._names, self._frames = known, tuple(names), frames
        if known is not None:
            expected = lifted(np.zeros(len(names))).shape if names else (len(known.centre),)
            if (len(known.centre),) != expected or (names and len(known.low) != len(names)):
                raise ValueError(
                    f"the training range is of {len(known.low)} numbers ({len(known.centre)} with products), the "
                    f"policy sees {len(names)}: measure it again with tacsim export policy-range"
                )
            self._centre, self._axes = np.array(known.centre), np.array(known.axes)
            self._low, self._high = np.array(known.low), np.array(known.high)
        self.reset()

    def reset(self) -> None:
        """A new episode."""
        self.largest = 0.0  # distance over its limit, of the episode so far
        self.now = 0.0  # the same of the last observation
        self._worst: FloatArray | None = None  # the numbers of the farthest observation

    def __call__(self, seen: Seen) -> None:
        """Takes the next observation."""
        if self.known is None:
            return
        numbers = numbers_of(seen, self._frames)
        self.now = float(distances(numbers, self._centre, self._axes)) / self.known.limit
        if self.now > self.largest:
            self.largest, self._worst = self.now, numbers

    @property
    def is_outside(self) -> bool:
        """An observation of this episode lies outside the range of training."""
        return self.largest > 1.0

    def words(self) -> str:
        """What is outside, for a person; the number of the farthest observation that leaves its own range most."""
        text = f"it observes what it did not observe in training (distance {self.largest:.1f} times the limit)"
        assert self.known is not None and self._worst is not None
        width = np.maximum(self._high - self._low, MIN_DEVIATION)
        beyond = np.maximum(self._low - self._worst, self._worst - self._high) / width
        at = int(np.argmax(beyond))
        if beyond[at] <= 0.0 or at >= len(self._names):
            return f"{text}: each number is known, their combination is not"
        return (
            f"{text}: {self._names[at]} is {self._worst[at]:.3g}, in training {self._low[at]:.3g} to "
            f"{self._high[at]:.3g} (encoded)"
        )


def scene_numbers(scene: Scene) -> dict[str, float | str]:
    """What a policy feels of a scene: each number of its gels, body, friction and gravity [SI], and the body's shape,
    by its key in the scene's file. What is not given has no key."""
    found: dict[str, float | str] = {}

    def walk(key: str, value: Any) -> None:
        if isinstance(value, Mapping):
            for name, each in value.items():
                walk(f"{key}.{name}", each)
        elif isinstance(value, Sequence) and not isinstance(value, str):
            for at, each in enumerate(value):
                walk(f"{key}[{at}]", each)
        elif key.rpartition(".")[2] in NOT_FELT or isinstance(value, bool):
            return
        elif isinstance(value, int | float):
            found[key] = float(value)
        elif key.endswith(".shape"):
            found[key] = str(value)

    whole = scene.model_dump(mode="json")
    for part in PHYSICAL:
        if whole.get(part) is not None:
            walk(part, whole[part])
    return found


def ranges_of(scenes: Sequence[Scene]) -> tuple[dict[str, tuple[float, float]], dict[str, tuple[str, ...]]]:
    """Least and greatest of each number of the `scenes`, and the words (shapes) that are in them."""
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


def outside_of_scenes(known: TrainingRange, scenes: Sequence[Scene]) -> list[str]:
    """The parameters of simulated `scenes` that training's scenes did not have, each in words; none if all lie
    within."""
    here, words = ranges_of(scenes)
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
