"""The state of a world as named arrays: how it is copied and restored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import Pose

State = Mapping[str, NDArray[Any]]  # arrays by name, in kernel units [mm, wave speed 1]
SENSORS = ("lower", "upper")  # gels by index


def gel_suffixes(groups: int) -> tuple[str, ...]:
    """Suffixes of the names of gel arrays: none where one array (gels, ...) holds all gels, which then have equal
    meshes; otherwise each gel has its own array (1, ...)."""
    return ("",) if groups == 1 else tuple(f"_{sensor}" for sensor in SENSORS)


def gel_arrays(state: State, name: str) -> dict[int, NDArray[Any]]:
    """The gel arrays called `name` in a state, by the index of the first gel in each."""
    found = {0: state[name]} if name in state else {}
    return found | {g: state[f"{name}_{s}"] for g, s in enumerate(SENSORS) if f"{name}_{s}" in state}


class LazyState(Mapping[str, NDArray[Any]]):
    """A state that is fetched at the first access."""

    def __init__(self, fetch: Callable[[], State]) -> None:
        self._fetch = fetch
        self._state: State | None = None

    def _fetch_once(self) -> State:
        if self._state is None:
            self._state = self._fetch()
        return self._state

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._fetch_once()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._fetch_once())

    def __len__(self) -> int:
        return len(self._fetch_once())


def copy_arrays(arrays: State) -> dict[str, NDArray[Any]]:
    """Copies in the same memory layout: rows of particles stay rows."""
    return {name: a.copy(order="K") for name, a in arrays.items()}


def snapshot_of(arrays: State, poses: Mapping[str, Pose]) -> dict[str, NDArray[Any]]:
    """A snapshot: copies of a world's arrays and the poses of its driven frames."""
    state = copy_arrays(arrays)
    state["poses"] = np.array([[*p.position, *p.quaternion] for p in poses.values()])
    return state


def restore_arrays(arrays: State, frames: Sequence[str], state: State, finite: Sequence[str] = ()) -> dict[str, Pose]:
    """Copies a snapshot into a world's arrays; returns the poses.

    finite: names of arrays that must be finite. Raises ValueError for a snapshot that does not fit; nothing is changed
    then.
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
