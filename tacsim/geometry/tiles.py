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

from tacsim.geometry.mesh import make_surface, signed_distance_on_grid
from tacsim.geometry.mesh_file import file_fingerprint
from tacsim.geometry.shapes import EXACT_BAND, LEVEL_SINE, MAX_NODES, centred_mesh
from tacsim.interface import FloatArray
from tacsim.models.scene import Mesh

Index = NDArray[np.int64]

TILE_NODES = 32  # nodes along an edge
MAX_SURFACES = 64  # meshes remembered in one process, the latest used; most have 1 to 4 MB
MAX_TILES = 2_000  # tiles in one process, of all meshes, those used last: 260 MB; one grid has 610 at most
MAX_SHARED_TILES = 4_000  # tiles in a folder that processes share: 520 MB

# By file, content, spacing and number, so that a tile keeps no mesh in memory; the oldest first. Worlds of several
# threads come here one after the other (`tacsim.compute.runtime.launching`).
_tiles: dict[tuple[Mesh, str, float, tuple[int, ...]], NDArray[np.float32]] = {}
_shared_folder: Path | None = None  # of tiles that other processes have, too
_on_tile: Callable[[str, int, int], None] | None = None


def share_tiles(folder: Path | None) -> None:
    """From now on tiles are also written into this folder, and taken from there: what one process has computed, others
    with the same folder need not. Computed and stored tiles have the same bits; a folder that is full or gone costs
    time only.
    """
    global _shared_folder
    _shared_folder = folder


@contextlib.contextmanager
def report_tiles(on_tile: Callable[[str, int, int], None]) -> Iterator[None]:
    """In the block `on_tile` is given the mesh's path, how many tiles are done, and of how many, before each tile."""
    global _on_tile
    before, _on_tile = _on_tile, on_tile
    try:
        yield
    finally:
        _on_tile = before


class TiledDistance:
    """Nodes lie at origin + spacing * (i, j, k), i, j, k from 0 on, and reach BAND spacings beyond the mesh's box."""

    def __init__(self, geometry: Mesh, content: str, spacing: float) -> None:
        """content: fingerprint of the file. Raises what :func:`tacsim.geometry.mesh_file.load_mesh` raises."""
        piece_count_range = (4_000, 100_000)  # at least, about at most
        piece_size = 4  # grid spacings: edge of the pieces that the surface is cut into for the search
        mesh = centred_mesh(geometry, content)
        self.name = geometry.path
        self.spacing = spacing
        self.vertices: FloatArray = np.asarray(mesh.vertices, np.float64)  # (n, 3)
        self._faces = np.asarray(mesh.faces, np.int64)  # (m, 3)
        self.half: FloatArray = np.asarray(mesh.extents, np.float64) / 2  # of the bounding box (3,)
        self.origin: FloatArray = -self.half - EXACT_BAND * spacing
        fewest, most = piece_count_range
        self._surface = make_surface(mesh, int(np.clip(2.3 * mesh.area / (piece_size * spacing) ** 2, fewest, most)))
        self._last = np.ceil((self.half - self.origin) / spacing + EXACT_BAND).astype(np.int64) // TILE_NODES
        self._key = geometry, content, spacing

    def lowest(self, axes: FloatArray, place: FloatArray, half: FloatArray) -> FloatArray | None:
        """The lowest point (3,) of the mesh turned by `axes` (3, 3) and then moved by `place` (3,) [m].

        Where that lies outside a rectangle of half sides `half` (2,) round the origin: the lowest point of the mesh's
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
        level = np.abs(step[:, 2]) <= LEVEL_SINE * np.linalg.norm(step, axis=1)
        share = np.where(level, (enter + leave) / 2, np.where(step[:, 2] > 0, enter, leave))
        points = start + share[:, None] * step
        return np.asarray(points[np.argmin(points[:, 2])])

    def tile_range(self, low: FloatArray, high: FloatArray) -> tuple[Index, Index]:
        """The first tile (3,) and the one after the last, along each axis, that points between two corners lie in."""
        first, last = (
            np.floor((at - self.origin) / (self.spacing * TILE_NODES)).astype(np.int64) for at in (low, high)
        )
        return np.clip(first, 0, self._last), np.clip(last, 0, self._last) + 1

    def values(self, first: Index, end: Index) -> NDArray[np.float32]:
        """Distances [m] at the nodes of tiles `first` (3,) to before `end`. Exact within BAND spacings of the surface,
        else as :func:`tacsim.geometry.mesh.signed_distance_on_grid` says. Raises ValueError for too many nodes."""
        counts = (end - first) * TILE_NODES
        if np.prod(counts.astype(float)) > MAX_NODES:
            raise ValueError(
                f"mesh {self.name}: a grid of {' x '.join(map(str, counts))} nodes {self.spacing * 1e3:.4g} mm apart "
                f"would be needed where it can touch; the limit is {MAX_NODES:,}"
            )
        found = np.empty(counts, np.float32)
        number = int(np.prod(end - first))
        for done, tile in enumerate(np.ndindex(*(end - first))):
            if _on_tile is not None:
                _on_tile(self.name, done, number)
            x, y, z = (slice(n * TILE_NODES, (n + 1) * TILE_NODES) for n in tile)
            found[x, y, z] = self._find_tile(tuple(int(n) for n in first + tile))
        return found

    def sample_distance(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distance (n,) [m] and its gradient (n, 3) [-] at `points` (n, 3) [m], trilinear between nodes.
        Raises what `values` raises."""
        if not len(points):
            return np.empty(0), np.empty((0, 3))
        first, end = self.tile_range(points.min(axis=0), points.max(axis=0) + self.spacing)
        origin = self.origin + TILE_NODES * self.spacing * first
        return trilinear_interpolation(self.values(first, end), (points - origin) / self.spacing, self.spacing)

    def _find_tile(self, index: tuple[int, ...]) -> NDArray[np.float32]:
        key = (*self._key, index)
        tile = _tiles.pop(key, None)
        if tile is None:
            tile = self._load_shared_tile(index)
        _tiles[key] = tile
        if len(_tiles) > MAX_TILES:
            del _tiles[next(iter(_tiles))]
        return tile

    def _load_shared_tile(self, index: tuple[int, ...]) -> NDArray[np.float32]:
        """The tile as another process has left it, or computed and left for others."""
        if _shared_folder is None:
            return self._compute_tile(index)
        geometry, content, spacing = self._key
        name = repr((geometry.model_dump(exclude={"path"}), content, spacing, index))
        path = _shared_folder / hashlib.sha256(name.encode()).hexdigest()
        with contextlib.suppress(OSError):
            data = path.read_bytes()
            if len(data) == 4 * TILE_NODES**3:
                return np.frombuffer(data, np.float32).reshape(TILE_NODES, TILE_NODES, TILE_NODES)
        tile = self._compute_tile(index)
        with contextlib.suppress(OSError):
            if sum(1 for _ in _shared_folder.iterdir()) < MAX_SHARED_TILES:
                partial = path.with_suffix(f".{os.getpid()}")
                partial.write_bytes(tile.tobytes())
                partial.replace(path)
        return tile

    def _compute_tile(self, index: tuple[int, ...]) -> NDArray[np.float32]:
        x, y, z = (
            start + self.spacing * (n * TILE_NODES + np.arange(TILE_NODES))
            for start, n in zip(self.origin, index, strict=True)
        )
        return signed_distance_on_grid(self._surface, (x, y, z), EXACT_BAND * self.spacing).astype(np.float32)


def trilinear_interpolation(
    values: NDArray[np.float32], at: FloatArray, spacing: float
) -> tuple[FloatArray, FloatArray]:
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


def cached_tiled_distance(geometry: Mesh, spacing: float) -> TiledDistance:
    """The same for the same bytes of the same file, so nothing is computed twice in one process."""
    return _make_cached(geometry, file_fingerprint(geometry.path), spacing)


_make_cached = lru_cache(maxsize=MAX_SURFACES)(TiledDistance)
