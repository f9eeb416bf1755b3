"""What is wrong in a state: volume ratios, speeds and numbers that are not finite, and where.

A state is the named arrays of a world (`World.snapshot`), in kernel units [mm, wave speed 1]. All worlds name alike
what they have alike: `gel_displacement` and `gel_velocity` of lattice gels, `position` and `velocity` of particles,
their `strain` e = b_e - I or `deformation_gradient`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

State = Mapping[str, NDArray[Any]]
Floats = NDArray[np.float64]
Size = tuple[float, float, float]
Quantity = Literal["corner", "element length", "node speed", "speed", "particle volume", "not finite"]
SENSORS = ("lower", "upper")  # gels by index


def not_finite(state: State) -> str | None:
    """The first entry that is not finite, in words, and how many of its array are not; None when all are finite."""
    for name, a in state.items():
        good = np.isfinite(a)
        if not good.all():
            index = tuple(int(i) for i in np.argwhere(~good)[0])
            count = int((~good).sum())
            many = f", with {count - 1} more of {a.size}" if count > 1 else ""
            return f"{name}{list(index)} is {a[index]}{many}"
    return None


def fastest_node(state: State) -> float:
    """Largest velocity component of a gel node / wave speed."""
    return float(np.abs(state["gel_velocity"]).max()) if "gel_velocity" in state else 0.0


def corner_volumes(state: State, thickness: float) -> Floats | None:
    """(gels, nx, ny, nz) smallest volume ratio at the 8 corners of the gels' elements; `thickness` of a gel [mm].

    The volume ratio at an element's centre, where its stress is computed, misses one that is turned over at a corner.
    """
    if "gel_displacement" not in state:
        return None
    u = np.moveaxis(state["gel_displacement"], -1, 0).astype(np.float64)  # component first
    h = thickness / (u.shape[-1] - 1)
    stretch = [np.diff(u, axis=axis) / h for axis in (2, 3, 4)]  # along x, y, z edges
    for axis in range(3):
        stretch[axis][axis] += 1.0
    n = [count - 1 for count in u.shape[2:]]
    least = np.full((u.shape[1], *n), np.inf)
    with np.errstate(all="ignore"):
        for corner in np.ndindex(2, 2, 2):
            i, j, k = (slice(c, c + m) for c, m in zip(corner, n, strict=True))
            x, y, z = stretch[0][:, :, :, j, k], stretch[1][:, :, i, :, k], stretch[2][:, :, i, j]
            least = np.minimum(least, _determinant((x, y, z)))
    return least


def nearly_at_rest(state: State, thickness: float) -> bool:
    """Whether all displacement gradients along the gels' edges are below 1/3: I + such a gradient is diagonally
    dominant, so no corner is turned over. Spares the price of `corner_volumes`.
    """
    u = state["gel_displacement"]
    most = max(float(np.abs(np.diff(u, axis=axis)).max()) for axis in (1, 2, 3))
    return bool(most < thickness / (u.shape[3] - 1) / 3.0)


def particle_volumes(state: State) -> Floats | None:
    """(n,) elastic volume ratio of the particles: sqrt(det b_e), or det F; NaN where b_e is not positive."""
    with np.errstate(all="ignore"):
        if "strain" in state:
            e = state["strain"]
            xx, yy, zz, xy, xz, yz = (e[:, i].astype(np.float64) for i in range(6))
            xx, yy, zz = xx + 1, yy + 1, zz + 1
            det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
            return np.sqrt(np.asarray(det))
        if "deformation_gradient" in state:
            return _determinant(np.moveaxis(state["deformation_gradient"].astype(np.float64), 0, -1))
    return None


def element_volumes(state: State, thickness: float) -> Floats | None:
    """(gels, nx, ny, nz) volume ratio at the centres of the gels' elements; `thickness` of a gel [mm]."""
    if "gel_displacement" not in state:
        return None
    with np.errstate(all="ignore"):
        return _determinant(_element_gradients(state, thickness))


def element_lengths(state: State, thickness: float) -> Floats:
    """(gels, nx, ny, nz) length of the gels' elements, the least of those along x, y and z of the lattice through their
    centres [mm]; `thickness` of a gel [mm]."""
    h = thickness / (state["gel_displacement"].shape[3] - 1)
    lengths: Floats = h * np.sqrt((_element_gradients(state, thickness) ** 2).sum(axis=0)).min(axis=0)
    return lengths


def _element_gradients(state: State, thickness: float) -> Floats:
    """(3, 3, gels, nx, ny, nz) deformation gradients at the elements' centres."""
    u = state["gel_displacement"].astype(np.float64)
    h = thickness / (u.shape[3] - 1)
    columns = []
    for axis in (1, 2, 3):
        step = np.diff(u, axis=axis) / h
        for other in (1, 2, 3):
            if other != axis:
                first, last = (np.take(step, range(a, step.shape[other] - 1 + a), axis=other) for a in (0, 1))
                step = (first + last) / 2
        columns.append(step)
    f: Floats = np.moveaxis(np.stack(columns, axis=-1), (-2, -1), (0, 1)) + np.eye(3)[:, :, None, None, None, None]
    return f


def _determinant(f: Floats | tuple[Floats, Floats, Floats]) -> Floats:
    """Of f (3, 3, ...), by rows or by columns."""
    a, b, c = f
    return np.asarray(
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def place_of_worst(quantity: Quantity, good: State, failed: State, gel: Size) -> str:
    """Which particle or gel node has the worst of `quantity` in `failed`, in words; "" where there is no such thing.

    Positions are those in `good`, the last state that was sound; `gel`: size of a gel [m].
    """
    if quantity == "corner":
        corners = corner_volumes(failed, gel[2] * 1e3)
        return "" if corners is None else _node(failed, _largest(-corners), gel)
    if quantity == "element length":
        if "gel_displacement" not in failed:
            return ""
        return _node(failed, _largest(-element_lengths(failed, gel[2] * 1e3)), gel)
    if quantity == "node speed" and "gel_velocity" in failed:
        return _node(good, _largest(np.abs(failed["gel_velocity"]).max(axis=-1)), gel)
    if quantity == "particle volume":
        volumes = particle_volumes(failed)
        return "" if volumes is None else _particle(good, _largest(-volumes)[0])
    if quantity == "not finite":
        return _first_not_finite(good, failed, gel)
    if "velocity" in failed:  # a seed's gel consists of particles too
        return _particle(good, _largest(np.abs(failed["velocity"]).max(axis=-1))[0])
    return ""


def _largest(values: NDArray[Any]) -> tuple[int, ...]:
    """Index of the largest entry; one that is not finite counts as larger than all."""
    flat = int(np.argmax(np.where(np.isfinite(values), values, np.inf)))
    return tuple(int(i) for i in np.unravel_index(flat, values.shape))


def _first_not_finite(good: State, failed: State, gel: Size) -> str:
    for name, a in failed.items():
        bad = np.argwhere(~np.isfinite(a))
        if len(bad):
            index = tuple(int(i) for i in bad[0])
            if name.startswith("gel_") and a.ndim == 5:
                return _node(good, index[:4], gel)
            if "position" in good and a.ndim and len(a) == len(good["position"]):
                return _particle(good, index[0])
    return ""


def _particle(good: State, index: int) -> str:
    return f"particle {index}, {millimetres(good['position'][index])} mm in the world"


def _node(good: State, index: tuple[int, ...], gel: Size) -> str:
    shape = np.array(good["gel_displacement"].shape[1:4]) - 1
    rest = (np.array(index[1:]) / shape - [0.5, 0.5, 1.0]) * np.array(gel) * 1e3
    return f"node {list(index[1:])} of the {SENSORS[index[0]]} gel, {millimetres(rest)} mm at rest in its sensor frame"


def millimetres(vector: NDArray[Any]) -> str:
    return "(" + ", ".join(f"{float(x):.3f}" for x in vector) + ")"
