"""Recorded presses and squeezes: the poses of the parts, and the measured signals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calibration.materials.fit import Signals
from tacsim.interface import FloatArray, Pose
from tacsim.pose import pose_difference

Quantity = Literal["force", "dent", "width", "slip"]
QUANTITY: dict[str, Quantity] = {
    "fx": "force", "fy": "force", "fz": "force", "dent": "dent", "width": "width", "slip_x": "slip", "slip_y": "slip",
}  # fmt: skip
MIN_CORNER_COSINE = np.cos(np.radians(20.0))  # of the directions of two steps; the path turns if it is smaller


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """One recorded press or squeeze, moment by moment."""

    name: str
    poses: Mapping[str, tuple[Pose, ...]]  # by the part that moves: n poses each
    readings: Mapping[str, FloatArray]  # by channel, such as "lower.fz": (n,) [N, or m], NaN where not measured
    time: FloatArray  # (n,) [s]
    repeats: NDArray[np.int64]  # (n,) number of readings in each mean
    ball: float | None = None  # radius of the pressed ball, if it is not the scene's indenter [m]

    @property
    def places(self) -> FloatArray:
        """(n, 6 k) positions of the k parts, and their rotation vectors times ARM [m]."""
        lever = 5e-3  # about half a gel: from its centre to its edge [m]
        turned = [[lever * pose_difference(poses[0], pose)[3:] for pose in poses] for poses in self.poses.values()]
        return np.hstack([*([pose.position for pose in poses] for poses in self.poses.values()), *turned])

    def at(self, moments: Sequence[int]) -> Press:
        """Only these moments."""
        chosen = np.array(moments)
        return replace(
            self,
            poses={part: tuple(poses[k] for k in moments) for part, poses in self.poses.items()},
            readings={channel: values[chosen] for channel, values in self.readings.items()},
            time=self.time[chosen],
            repeats=self.repeats[chosen],
        )


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of single readings."""

    force: float = 0.02  # [N]
    dent: float = 5e-6  # of the root mean square of a height map [m]
    width: float = 50e-6  # of the width of a dent: an error of the pixel pitch by 2 % [m]
    slip: float = 10e-6  # of the mean of a flow [m]


def merge_repeated_readings(press: Press) -> Press:
    """The press with the mean of readings that were taken in one place."""
    same_place = 1e-6  # parts that move less are in the same place [m]
    places = press.places
    moved = np.abs(np.diff(places, axis=0)).max(axis=1) > same_place
    group = np.concatenate([[0], np.cumsum(moved)])
    first = [int(np.flatnonzero(group == k)[0]) for k in range(group[-1] + 1)]
    result = press.at(first)
    mean = [group == k for k in range(group[-1] + 1)]
    return replace(
        result,
        readings={name: np.array([values[rows].mean() for rows in mean]) for name, values in press.readings.items()},
        time=np.array([press.time[rows].mean() for rows in mean]),
        repeats=np.array([int(press.repeats[rows].sum()) for rows in mean]),
    )


def downsample_press(press: Press, max_moments: int) -> Press:
    """At most about `max_moments` moments, evenly along the path, with its ends and the points where it turns."""
    places = press.places
    count = len(places)
    if count <= max_moments:
        return press
    steps = np.diff(places, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    kept = {0, count - 1}
    for k in range(1, count - 1):
        both = lengths[k - 1] * lengths[k]
        if both > 0 and steps[k - 1] @ steps[k] < MIN_CORNER_COSINE * both:
            kept.add(k)
    kept |= {int(np.argmin(np.abs(along - at))) for at in np.linspace(0.0, along[-1], max_moments)}
    return press.at(sorted(kept))


def signals_of(presses: Sequence[Press], noise: Noise) -> Signals:
    """All measured signals as rows of a fit, in the order of press, channel and moment."""
    channels = tuple(sorted({name for press in presses for name in press.readings}))
    rows: list[tuple[FloatArray, FloatArray, FloatArray, int, int]] = []
    for index, press in enumerate(presses):
        for name, values in press.readings.items():
            there = np.isfinite(values)
            spread = getattr(noise, QUANTITY[name.partition(".")[2]]) / np.sqrt(press.repeats[there])
            rows.append((values[there], spread, press.time[there], index, channels.index(name)))
    return Signals(
        values=np.concatenate([row[0] for row in rows]),
        noise=np.concatenate([row[1] for row in rows]),
        press=np.concatenate([np.full(len(row[0]), row[3]) for row in rows]),
        channel=np.concatenate([np.full(len(row[0]), row[4]) for row in rows]),
        time=np.concatenate([row[2] for row in rows]),
        channels=channels,
        force=np.array([QUANTITY[name.partition(".")[2]] == "force" for name in channels]),
    )
