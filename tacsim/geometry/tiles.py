"""Signed distance from a mesh on a grid whose tiles are computed where they are asked for; in the mesh's frame, metres.

A whole mesh may need a hundred million nodes, and which part touches is known only as it moves. The values of a tile
do not depend on when, or with which others, it is computed.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tacsim.geometry.mesh import fingerprint, make_surface, signed_distance_on_grid
from tacsim.geometry.shapes import BAND, LEVEL, MAX_NODES, centred
from tacsim.interface import FloatArray
from tacsim.models.scene import Mesh

Index = NDArray[np.int64]

TILE = 32  # nodes along an edge
SURFACES = 64  # meshes remembered in one process, the latest used; most have 1 to 4 MB
KEPT = 2_000  # tiles in one process, of all meshes, those used last: 260 MB; one grid has 610 at most
SHARED = 4_000  # tiles in a folder that processes share: 520 MB

# By file, content, spacing and number, so that a tile keeps no mesh in memory; the oldest first. Worlds of several
# threads come here one after the other (`tacsim.compute.runtime.launching`).
_kept: dict[tuple[Mesh, str, float, tuple[int, ...]], NDArray[np.float32]] = {}
_folder: Path | None = None  # of tiles that other processes have, too
_watcher: Callable[[str, int, int], None] | None = None


def share_tiles(folder: Path | None) -> None:
    """From now on tiles are also written into this folder, and taken from there: what one process has computed, others
    with the same folder need not. A tile has the same bits either way; a folder that is full or gone costs time alone.
    """
    global _folder
    _folder = folder


@contextlib.contextmanager
def watched_measuring(on_tile: Callable[[str, int, int], None]) -> Iterator[None]:
    """In the block `on_tile` is given the mesh's path, how many tiles are done, and of how many, before each tile."""
    global _watcher
    before, _watcher = _watcher, on_tile
    try:
        yield
    finally:
        _watcher = before


class TiledDistance:
    """Nodes lie at origin + spacing * (i, j, k), i, j, k from 0 on, and reach BAND spacings beyond the mesh's box."""

    def __init__(self, geometry: Mesh, content: str, spacing: float) -> None:
        """content: fingerprint of the file. Raises what :func:`tacsim.geometry.mesh.load_mesh` raises."""
        piece_counts = (4_000, 100_000)  # at least, about at most
        piece = 4  # grid spacings: edge of the pieces that the surface is cut into for the search
        mesh = centred(geometry, content)
        self.name = geometry.path
        self.spacing = spacing
        self.vertices: FloatArray = np.asarray(mesh.vertices, np.float64)  # (n, 3)
        self._faces = np.asarray(mesh.faces, np.int64)  # (m, 3)
        self.half: FloatArray = np.asarray(mesh.extents, np.float64) / 2  # of the bounding box (3,)
        self.origin: FloatArray = -self.half - BAND * spacing
        fewest, most = piece_counts
        self._surface = make_surface(mesh, int(np.clip(2.3 * mesh.area / (piece * spacing) ** 2, fewest, most)))
        self._last = np.ceil((self.half - self.origin) / spacing + BAND).astype(np.int64) // TILE
        self._key = geometry, content, spacing

    def lowest(self, axes: FloatArray, place: FloatArray, half: FloatArray) -> FloatArray | None:
        """The lowest point (3,) of the mesh turned by `axes` (3, 3) and then moved by `place` (3,) [m].

        Where that lies beside a rectangle of half sides `half` (2,) round the origin: the lowest point of the mesh's
        edges over the rectangle, of a level edge the middle; None where there is no edge."""
        at = self.vertices @ axes.T + place
        tip: FloatArray = at[np.argmin(at[:, 2])]
        if (np.abs(tip[:2]) <= half).all():
            return tip
        start, end = at[self._faces].reshape(-1, 3), at[np.roll(self._faces, -1, axis=1)].reshape(-1, 3)
        step = end - start
        with np.errstate(divide="ignore", invalid="ignore"):  # 0 / 0 of an edge along a side is within it
            crossings = (np.stack([-half, half])[:, None] - start[:, :2]) / step[:, :2]
        enter = np.fmax(np.nan_to_num(np.fmin(*crossings), nan=-np.inf, neginf=-np.inf).max(axis=1), 0.0)
        leave = np.fmin(np.nan_to_num(np.fmax(*crossings), nan=np.inf, posinf=np.inf).min(axis=1), 1.0)
        over = enter <= leave
        if not over.any():
            return None
        start, step, enter, leave = start[over], step[over], enter[over], leave[over]
        level = np.abs(step[:, 2]) <= LEVEL * np.linalg.norm(step, axis=1)
        share = np.where(level, (enter + leave) / 2, np.where(step[:, 2] > 0, enter, leave))
        points = start + share[:, None] * step
        return np.asarray(points[np.argmin(points[:, 2])])

    def around(self, low: FloatArray, high: FloatArray) -> tuple[Index, Index]:
        """The first tile (3,) and the one after the last, along each axis, that points between two corners lie in."""
        first, last = (np.floor((at - self.origin) / (self.spacing * TILE)).astype(np.int64) for at in (low, high))
        return np.clip(first, 0, self._last), np.clip(last, 0, self._last) + 1

    def values(self, first: Index, end: Index) -> NDArray[np.float32]:
        """Distances [m] at the nodes of tiles `first` (3,) to before `end`. Exact within BAND spacings of the surface,
        else as :func:`tacsim.geometry.mesh.signed_distance_on_grid` says. Raises ValueError for too many nodes."""
        counts = (end - first) * TILE
        if np.prod(counts.astype(float)) > MAX_NODES:
            raise ValueError(
                f"mesh {self.name}: a grid of {' x '.join(map(str, counts))} nodes {self.spacing * 1e3:.4g} mm apart "
                f"would be needed where it can touch; the limit is {MAX_NODES:,}"
            )
        found = np.empty(counts, np.float32)
        number = int(np.prod(end - first))
        for done, tile in enumerate(np.ndindex(*(end - first))):
            if _watcher is not None:
                _watcher(self.name, done, number)
            x, y, z = (slice(n * TILE, (n + 1) * TILE) for n in tile)
            found[x, y, z] = self._tile(tuple(int(n) for n in first + tile))
        return found

    def sample(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distance (n,) [m] and its gradient (n, 3) [-] at `points` (n, 3) [m], trilinear between nodes.
        Raises what `values` raises."""
        if not len(points):
            return np.empty(0), np.empty((0, 3))
        first, end = self.around(points.min(axis=0), points.max(axis=0) + self.spacing)
        origin = self.origin + TILE * self.spacing * first
        return trilinear(self.values(first, end), (points - origin) / self.spacing, self.spacing)

    def _tile(self, index: tuple[int, ...]) -> NDArray[np.float32]:
        key = (*self._key, index)
        tile = _kept.pop(key, None)
        if tile is None:
            tile = self._shared(index)
        _kept[key] = tile
        if len(_kept) > KEPT:
            del _kept[next(iter(_kept))]
        return tile

    def _shared(self, index: tuple[int, ...]) -> NDArray[np.float32]:
        """The tile as another process has left it, or computed and left for others."""
        if _folder is None:
            return self._computed(index)
        geometry, content, spacing = self._key
        name = repr((geometry.model_dump(exclude={"path"}), content, spacing, index))
        path = _folder / hashlib.sha256(name.encode()).hexdigest()
        with contextlib.suppress(OSError):
            data = path.read_bytes()
            if len(data) == 4 * TILE**3:
                return np.frombuffer(data, np.float32).reshape(TILE, TILE, TILE)
        tile = self._computed(index)
        with contextlib.suppress(OSError):
            if sum(1 for _ in _folder.iterdir()) < SHARED:
                partial = path.with_suffix(f".{os.getpid()}")
                partial.write_bytes(tile.tobytes())
                partial.replace(path)
        return tile

    def _computed(self, index: tuple[int, ...]) -> NDArray[np.float32]:
        x, y, z = (
            start + self.spacing * (n * TILE + np.arange(TILE)) for start, n in zip(self.origin, index, strict=True)
        )
        return signed_distance_on_grid(self._surface, (x, y, z), BAND * self.spacing).astype(np.float32)


def trilinear(values: NDArray[np.float32], at: FloatArray, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Values (n,) between the nodes of a grid, `spacing` [m] apart, and their gradient (n, 3) [1/m], at places (n, 3)
    counted in nodes: the reference for kernels.

    Outside the grid nothing is known: value +inf, gradient 0.
    """
    last = np.array(values.shape) - 1
    known: NDArray[np.bool_] = np.all((at >= 0) & (at <= last), axis=1)
    cell = np.clip(np.floor(np.where(known[:, None], at, 0.0)).astype(int), 0, last - 1)
    upper = np.where(known[:, None], at, 0.0) - cell  # weight of the upper node along each axis
    value = np.zeros(len(at))
    gradient = np.zeros((len(at), 3))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, upper, 1.0 - upper)
        node = values[tuple((cell + corner).T)].astype(np.float64)
        value += node * weight.prod(axis=1)
        for axis in range(3):
            others = np.delete(weight, axis, axis=1).prod(axis=1)
            gradient[:, axis] += (node if corner[axis] else -node) * others / spacing
    return np.where(known, value, np.inf), np.where(known[:, None], gradient, 0.0)


def tiled_distance(geometry: Mesh, spacing: float) -> TiledDistance:
    """The same for the same bytes of the same file, so nothing is computed twice in one process."""
    return _remembered(geometry, fingerprint(geometry.path), spacing)


_remembered = lru_cache(maxsize=SURFACES)(TiledDistance)
