"""The state of a world as named arrays: copies of it, and how they are put back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose

State = Mapping[str, NDArray[Any]]  # arrays by name, in kernel units [mm, wave speed 1]
SENSORS = ("lower", "upper")  # gels by index


def gel_suffixes(groups: int) -> tuple[str, ...]:
    """What follows the name of an array of gels: nothing where one array (gels, ...) holds all of them, which are then
    cut alike; else each has an array (1, ...) of its own."""
    return ("",) if groups == 1 else tuple(f"_{sensor}" for sensor in SENSORS)


def gel_arrays(state: State, name: str) -> dict[int, NDArray[Any]]:
    """The arrays of gels in a state that are called `name`, by the index of the first gel in each."""
    found = {0: state[name]} if name in state else {}
    return found | {g: state[f"{name}_{s}"] for g, s in enumerate(SENSORS) if f"{name}_{s}" in state}


class Kept(Mapping[str, NDArray[Any]]):
    """A state that is fetched when somebody looks into it."""

    def __init__(self, fetch: Callable[[], State]) -> None:
        self._fetch = fetch
        self._state: State | None = None

    def _whole(self) -> State:
        if self._state is None:
            self._state = self._fetch()
        return self._state

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._whole()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._whole())

    def __len__(self) -> int:
        return len(self._whole())


def copies(arrays: State) -> dict[str, NDArray[Any]]:
    """Copies in the same memory layout: particles' numbers are rows."""
    return {name: a.copy(order="K") for name, a in arrays.items()}


def snapshot_of(arrays: State, poses: Mapping[str, Pose]) -> dict[str, NDArray[Any]]:
    """A snapshot: copies of a world's arrays, and the poses of its driven frames."""
    state = copies(arrays)
    state["poses"] = np.array([[*p.position, *p.quaternion] for p in poses.values()])
    return state


def restore_arrays(arrays: State, frames: Sequence[str], state: State, finite: Sequence[str] = ()) -> dict[str, Pose]:
    """Copies a snapshot into a world's arrays; returns the poses.

    finite: names of arrays from which no motion can begin unless they are finite. Raises ValueError for a snapshot that
    does not fit; then nothing is changed.
    """
    found = {name: np.asarray(state[name]) for name in (*arrays, "poses") if name in state}
    for name, wanted in {**arrays, "poses": np.empty((len(frames), 7))}.items():
        if name not in found or found[name].shape != wanted.shape:
            shape = found[name].shape if name in found else "nothing"
            raise ValueError(f"snapshot: '{name}' must have shape {wanted.shape}, found {shape}; is it of this scene?")
        if not np.can_cast(found[name].dtype, wanted.dtype, "same_kind"):
            raise ValueError(f"snapshot: '{name}' must hold {wanted.dtype}, found {found[name].dtype}")
        if name in finite and not np.isfinite(found[name]).all():
            raise ValueError(f"snapshot: '{name}' is not finite; restore another one")
    poses = {}
    for frame, numbers in zip(frames, found["poses"], strict=True):
        try:
            poses[frame] = Pose(numbers[:3], numbers[3:])
        except ValueError as error:
            raise ValueError(f"snapshot: 'poses' of '{frame}': {error}") from None
    for name, a in arrays.items():
        a[...] = found[name]
    return poses
