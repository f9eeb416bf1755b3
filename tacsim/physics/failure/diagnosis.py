"""Diagnosis of a state: volume ratios, speeds and numbers that are not finite, and the place of the worst value.

A state holds the arrays of a world by name, in kernel units [mm, wave speed 1]. All worlds use the same names:
`gel_displacement` and `gel_velocity` of gel lattices (tacsim.physics.snapshot.gel_arrays), `position` and `velocity` of
particles, and their `strain` b_e - I or `deformation_gradient`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tacsim.physics.snapshot import SENSORS, State, gel_arrays

Floats = NDArray[np.float64]
Size = tuple[float, float, float]
Quantity = Literal["corner", "element length", "node speed", "particle speed", "particle volume", "not finite"]


def describe_non_finite(state: State) -> str | None:
    """Text with the first entry that is not finite, and how many of its array are not; None when all are finite."""
    for name, a in state.items():
        if np.isfinite(a).all():
            continue
        bad = np.argwhere(~np.isfinite(a))
        index = tuple(map(int, bad[0]))
        more = f", with {len(bad) - 1} more of {a.size}" if len(bad) > 1 else ""
        return f"{name}{list(index)} is {a[index]}{more}"
    return None


def particle_volumes(state: State) -> Floats | None:
    """(n,) elastic volume ratio of the particles: sqrt(det b_e), or det F; NaN where b_e is not positive."""
    with np.errstate(all="ignore"):
        if "strain" in state:
            root: Floats = np.sqrt(_squared_volumes(state["strain"].T.astype(np.float64)))
            return root
        if "deformation_gradient" in state:
            return _determinant(*np.moveaxis(state["deformation_gradient"].astype(np.float64), 0, -1))
    return None


def volume_range(strain: NDArray[np.float32]) -> tuple[float, float]:
    """Smallest and largest elastic volume ratio of particles with strains (n, 6), in single precision, which takes a
    quarter of the time of `particle_volumes`; NaN where b_e is not positive."""
    squared = _squared_volumes(strain.T)
    with np.errstate(invalid="ignore"):
        return float(np.sqrt(squared.min())), float(np.sqrt(squared.max()))


def volumes_exceed_twice(state: State, limit: float) -> bool:
    """Whether all elastic volume ratios are above twice `limit`. False for a state without strains."""
    return "strain" in state and volume_range(state["strain"])[0] > 2.0 * limit


def _squared_volumes(strain: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """(n,) det b_e of b_e - I (6, n)."""
    xx, yy, zz, xy, xz, yz = strain
    xx, yy, zz = xx + 1, yy + 1, zz + 1
    det: NDArray[np.floating[Any]] = (
        xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    )  # fmt: skip
    return det


def element_volumes(u: NDArray[Any], thickness: float) -> Floats:
    """(gels, nx, ny, nz) volume ratio at the centres of the elements of gels with node displacements `u`
    (gels, nx + 1, ny + 1, nz + 1, 3) [mm]; `thickness` of a gel [mm]."""
    with np.errstate(all="ignore"):
        return _determinant(*_element_edges(u, thickness))


def corner_volumes(u: NDArray[Any], thickness: float) -> Floats:
    """(gels, nx, ny, nz) smallest volume ratio at the 8 corners of the elements; arguments as above.

    The volume ratio at an element's centre, where its stress is computed, does not show an inversion at a corner.
    """
    along = _edge_gradients(u, thickness)
    for axis, edge in enumerate(along):
        edge[axis] += 1.0
    n = [count - 1 for count in u.shape[1:4]]
    least = np.full((along[0].shape[1], *n), np.inf)
    with np.errstate(all="ignore"):
        for corner in np.ndindex(2, 2, 2):
            i, j, k = (slice(c, c + m) for c, m in zip(corner, n, strict=True))
            det = _determinant(along[0][:, :, :, j, k], along[1][:, :, i, :, k], along[2][:, :, i, j])
            least = np.minimum(least, det)
    return least


def element_lengths(u: NDArray[Any], thickness: float) -> Floats:
    """(gels, nx, ny, nz) smallest of the lengths of an element along x, y and z of the lattice, through its centre
    [mm]; arguments as above."""
    h = thickness / (u.shape[3] - 1)
    lengths: Floats = h * np.sqrt((_element_edges(u, thickness) ** 2).sum(axis=1)).min(axis=0)
    return lengths


def has_small_gradients(u: NDArray[Any], thickness: float) -> bool:
    """Whether all displacement gradients along the edges are below 1/3: I + such a gradient is diagonally dominant, so
    no corner is inverted. Faster than `corner_volumes`; arguments as above.
    """
    largest = max(float(np.abs(np.diff(u, axis=axis)).max()) for axis in (1, 2, 3))
    return bool(largest < thickness / (u.shape[3] - 1) / 3.0)


def _edge_gradients(displacement: NDArray[Any], thickness: float) -> list[Floats]:
    """Displacement gradients along the x, y and z edges of the gels' lattices: three (3, gels, nx, ny, nz), each with
    one entry less along its own axis."""
    u = np.moveaxis(displacement, -1, 0).astype(np.float64)
    h = thickness / (u.shape[-1] - 1)
    return [np.diff(u, axis=axis) / h for axis in (2, 3, 4)]


def _element_edges(u: NDArray[Any], thickness: float) -> Floats:
    """(3, 3, gels, nx, ny, nz) mean edges of the elements over their length at rest: the columns of the deformation
    gradients at their centres."""
    columns = _edge_gradients(u, thickness)
    for axis, column in enumerate(columns):
        for other in {0, 1, 2} - {axis}:
            ends = np.delete(column, -1, axis=other + 2), np.delete(column, 0, axis=other + 2)
            column = (ends[0] + ends[1]) / 2
        columns[axis] = column
    return np.stack(columns) + np.eye(3)[:, :, None, None, None, None]


def _determinant(a: Floats, b: Floats, c: Floats) -> Floats:
    """Determinants of matrices with the columns (or rows) a, b, c, each (3, ...)."""
    return np.asarray(
        a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def describe_worst_place(quantity: Quantity, good: State, failed: State, gels: Sequence[Size]) -> str:
    """Text that names the particle or gel node with the worst value of `quantity` in `failed`; "" if there is none. If
    more than half of the values in `failed` are not finite, the worst value in `good`, the last physical state.

    Positions are those in `good`; `gels`: size of each gel [m].
    """
    values, first = _severity(quantity, failed, gels)
    if values is not None and quantity != "not finite" and np.isfinite(values).mean() < 0.5:
        values, first = _severity(quantity, good, gels)
    if values is None:
        return ""
    flat = int(np.argmax(_replace_non_finite(values)))
    index = [int(i) for i in np.unravel_index(flat, values.shape)]
    if values.ndim >= 4:
        gel = first + index[0]
        cells = np.array(gel_arrays(failed, "gel_displacement")[first].shape[1:4]) - 1
        at = (np.array(index[1:4]) / cells - [0.5, 0.5, 1.0]) * np.array(gels[gel]) * 1e3
        return f"node {index[1:4]} of the {SENSORS[gel]} gel, {format_millimetres(at)} mm at rest in its sensor frame"
    if "position" in good and values.ndim and len(values) == len(good["position"]):
        return f"particle {index[0]}, {format_millimetres(good['position'][index[0]])} mm in the world"
    return ""


def _replace_non_finite(values: NDArray[Any]) -> NDArray[Any]:
    """The values with infinity in place of those that are not finite."""
    return np.where(np.isfinite(values), values, np.inf)


def _severity(quantity: Quantity, failed: State, gels: Sequence[Size]) -> tuple[NDArray[Any] | None, int]:
    """Severity of each node or element of the gels, or of each particle, where larger is worse; and the index of the
    first gel in it. `gels`: size of each gel [m]."""
    found: list[tuple[NDArray[Any], int]] = []
    displacements = gel_arrays(failed, "gel_displacement")
    if quantity == "not finite":
        of_gels = {f"{name}_{SENSORS[1]}" for name in ("gel_displacement", "gel_velocity")}
        bad = [(~np.isfinite(a), int(name in of_gels)) for name, a in failed.items() if not np.isfinite(a).all()]
        found = bad[:1]
    elif quantity == "particle volume":
        volumes = particle_volumes(failed)
        found = [] if volumes is None else [(-volumes, 0)]
    elif displacements and quantity != "particle speed":
        if quantity == "node speed":
            found = [(np.abs(v), g) for g, v in gel_arrays(failed, "gel_velocity").items()]
        else:
            measure = corner_volumes if quantity == "corner" else element_lengths
            found = [(-measure(u, gels[g][2] * 1e3), g) for g, u in displacements.items()]
    elif "velocity" in failed:  # the gels of physics 'seed' consist of particles too
        found = [(np.abs(failed["velocity"]), 0)]
    if not found:
        return None, 0
    return max(found, key=lambda each: float(_replace_non_finite(each[0]).max()))


def format_millimetres(vector: NDArray[Any]) -> str:
    return "(" + ", ".join(f"{float(x):.3f}" for x in vector) + ")"
