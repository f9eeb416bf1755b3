"""The exact signed distance to the surface of a closed triangle mesh."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from scipy.spatial import KDTree
    from trimesh import Trimesh

IntArray = NDArray[np.int64]
Axes = tuple[FloatArray, FloatArray, FloatArray]

_CHUNK = 500_000  # rows worked on at once, for memory


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A mesh prepared for distance queries: cut into small pieces for the search, normals of faces, edges, corners."""

    unit: float  # [m]; the mesh measures 1000 units, where the absolute tolerances of trimesh are negligible
    triangles: FloatArray  # (m, 3, 3) [unit]
    normals: FloatArray  # (m, 7, 3) face; edges 01, 12, 20; corners 0, 1, 2
    tree: KDTree  # centres of the pieces
    centre: FloatArray  # (p, 3) of each piece [unit]
    radius: FloatArray  # (p,) largest distance from a piece's centre to any of its points [unit]
    parent: IntArray  # (p,) the triangle of each piece

    @property
    def reach(self) -> float:
        return float(self.radius.max())


def make_surface(mesh: Trimesh, pieces: int = 4_000) -> Surface:
    """`mesh`: closed and consistently wound, as :func:`tacsim.geometry.mesh_file.load_mesh` gives it; it is cut into
    `pieces` or a few times more."""
    from scipy.spatial import KDTree
    from trimesh.remesh import subdivide_to_size

    unit = float(mesh.extents.max()) / 1000.0
    vertices = np.asarray(mesh.vertices) / unit
    edge = float(np.sqrt(2.3 * mesh.area / unit**2 / pieces))  # an equilateral triangle of this edge is one piece
    cut_up = subdivide_to_size(vertices, mesh.faces, edge, max_iter=60, return_index=True)  # type: ignore[no-untyped-call]
    corners, faces, parent = cut_up
    cut = corners[faces]
    centre = cut.mean(axis=1)
    along = mesh.edges_unique_inverse.reshape(-1, 3)
    edge_normals = np.zeros((len(mesh.edges_unique), 3))
    np.add.at(edge_normals, along, mesh.face_normals[:, None, :])
    corner_normals = mesh.vertex_normals[mesh.faces]  # weighted by the angles of the faces
    return Surface(
        unit=unit,
        triangles=vertices[mesh.faces],
        normals=np.concatenate([mesh.face_normals[:, None, :], edge_normals[along], corner_normals], axis=1),
        tree=KDTree(centre),
        centre=centre,
        radius=np.linalg.norm(cut - centre[:, None, :], axis=2).max(axis=1),
        parent=np.asarray(parent, dtype=np.int64),
    )


def signed_distance(surface: Surface, points: FloatArray) -> FloatArray:
    """Exact Euclidean distance (n,) [m] of `points` (n, 3) [m] from the surface, negative inside.

    A piece within d of a point has its centre within d + reach, so candidates are complete once the k-th nearest centre
    lies beyond best + reach; k grows until it does. Sign: angle-weighted pseudonormals, Baerentzen and Aanaes, IEEE
    Trans. Vis. Comput. Graph. 11(3), 2005, theorem 1.
    """
    return _nearest_triangles(surface, points / surface.unit)[0] * surface.unit


def distance_gradient(surface: Surface, points: FloatArray) -> FloatArray:
    """Unit gradient (n, 3) [-] of the signed distance at `points` (n, 3) [m]: the outward direction of the nearest
    point of the surface; a point on the surface itself gets the normal there."""
    at = points / surface.unit
    value, triangle = _nearest_triangles(surface, at)
    closest = _triangle_distances(surface, at, triangle)[1]
    on, normals = np.abs(value) < 1e-6, _pseudonormals(surface, closest, triangle)
    gradient = np.where(on[:, None], normals, (at - closest) * np.sign(value)[:, None])
    return np.asarray(gradient / np.linalg.norm(gradient, axis=1, keepdims=True))


def signed_distance_on_grid(surface: Surface, axes: Axes, band: float) -> FloatArray:
    """Signed distance (nx, ny, nz) [m] at the nodes of a regular grid of cubic cells, coordinates `axes` [m].

    Exact where it is below `band` [m] (at least one grid spacing). Beyond, the sign is right and the value is the
    distance to the triangle that is nearest to the nearest node in the band: never too small; too large only where
    several triangles are nearly as near (by half a spacing at most in the tests: the centre of a ball), or where the
    grid leaves out the nearest part of the surface. Where no node lies within `band`, one that is next to it is exact.
    """
    from scipy.ndimage import distance_transform_edt

    shape = (len(axes[0]), len(axes[1]), len(axes[2]))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) / surface.unit
    limit = band / surface.unit + surface.reach
    near = np.isfinite(surface.tree.query(points, distance_upper_bound=limit)[0])
    if not near.any():
        near[_nearest_node(surface, points, shape)] = True
    values = np.empty(len(points))
    triangle = np.empty(len(points), dtype=np.int64)
    values[near], triangle[near] = _nearest_triangles(surface, points[near])
    far = ~near.reshape(shape)
    if far.any():
        source = distance_transform_edt(far, return_distances=False, return_indices=True)
        triangle = triangle[np.ravel_multi_index(tuple(source), shape).ravel()]
        away = far.ravel()
        for chunk in _row_chunks(len(points), _CHUNK):
            rows = np.flatnonzero(away[chunk]) + chunk.start
            values[rows] = _triangle_distances(surface, points[rows], triangle[rows])[0]
        values[away] *= _node_signs(surface, points, far)[away]
    return (values * surface.unit).reshape(shape)


def _nearest_node(surface: Surface, points: FloatArray, shape: tuple[int, int, int]) -> int:
    """Index of the node of a grid (n, 3) of `shape`, into which no surface comes, that is nearest to a piece. It lies
    on the grid's border; what is farther than the nearest corner is not searched for: among the many nodes that are
    about as far from all pieces of a ball, a search for each would take a second a grid."""
    index = np.stack(np.unravel_index(np.arange(len(points)), shape), axis=1)
    last = np.array(shape) - 1
    at_end = (index == 0) | (index == last)
    border = np.flatnonzero(at_end.any(axis=1))
    limit = float(np.min(surface.tree.query(points[at_end.all(axis=1)])[0]))
    away = surface.tree.query(points[border], distance_upper_bound=limit * (1 + 1e-9) + 1e-9)[0]
    return int(border[np.argmin(away)])


def _node_signs(surface: Surface, points: FloatArray, far: NDArray[np.bool_]) -> FloatArray:
    """Sign at the nodes that are `far`: no connected region of them crosses the surface, so one node decides for it."""
    from scipy.ndimage import label

    regions, count = label(far)
    found, first = np.unique(regions, return_index=True)
    signs = np.zeros(count + 1)
    signs[1:] = np.where(_nearest_triangles(surface, points[first[found > 0]])[0] < 0, -1.0, 1.0)
    return np.asarray(signs[regions.ravel()])


def _row_chunks(count: int, size: int) -> Iterator[slice]:
    return (slice(start, min(start + size, count)) for start in range(0, count, size))


def _nearest_triangles(surface: Surface, points: FloatArray) -> tuple[FloatArray, IntArray]:
    """Signed distance (n,) and nearest triangle (n,) of `points` (n, 3). [unit]"""
    value, triangle = np.empty(len(points)), np.empty(len(points), dtype=np.int64)
    todo, k = np.arange(len(points)), min(16, len(surface.parent))
    while todo.size:
        later = []
        for part in _row_chunks(len(todo), max(1, _CHUNK // k)):
            rows = todo[part]
            value[rows], triangle[rows], complete = _nearest_of_pieces(surface, points[rows], k)
            later.append(rows[~complete])
        todo, k = np.concatenate(later), min(4 * k, len(surface.parent))
    return value, triangle


def _nearest_of_pieces(surface: Surface, points: FloatArray, k: int) -> tuple[FloatArray, IntArray, NDArray[np.bool_]]:
    """Signed distance to the triangles of the k nearest pieces, the nearest one, and whether no other can be nearer."""
    away, piece = (np.asarray(found).reshape(len(points), k) for found in surface.tree.query(points, k=k))
    bound, _ = _triangle_distances(surface, points, surface.parent[piece[:, 0]])
    # A piece lies in a disc: a lower bound of its distance spares most of the exact ones.
    offset = points[:, None, :] - surface.centre[piece]
    normal = surface.normals[surface.parent[piece], 0]
    height = np.einsum("ijk,ijk->ij", offset, normal)
    sideways = np.linalg.norm(offset - height[..., None] * normal, axis=2) - surface.radius[piece]
    row, column = np.nonzero(np.hypot(height, np.maximum(sideways, 0.0)) <= bound[:, None] * (1 + 1e-9) + 1e-9)
    triangle = surface.parent[piece[row, column]]
    distance, closest = _triangle_distances(surface, points[row], triangle)
    order = np.lexsort((distance, row))
    best = order[np.searchsorted(row[order], np.arange(len(points)))]
    outward = _pseudonormals(surface, closest[best], triangle[best])
    inside = np.einsum("ij,ij->i", points - closest[best], outward) < 0
    complete = (away[:, -1] >= distance[best] + surface.reach) | (k == len(surface.parent))
    return np.where(inside, -distance[best], distance[best]), triangle[best], complete


def _triangle_distances(surface: Surface, points: FloatArray, triangle: IntArray) -> tuple[FloatArray, FloatArray]:
    """Distance (n,) of each point from its triangle, and the closest point (n, 3). [unit]"""
    from trimesh.triangles import closest_point

    closest = closest_point(surface.triangles[triangle], points)  # type: ignore[no-untyped-call]
    return np.linalg.norm(points - closest, axis=1), closest


def _pseudonormals(surface: Surface, closest: FloatArray, triangle: IntArray) -> FloatArray:
    """Normal (n, 3) of the face, edge or corner on which each closest point lies (any length)."""
    from trimesh.triangles import points_to_barycentric

    weights = points_to_barycentric(surface.triangles[triangle], closest)  # type: ignore[no-untyped-call]
    off = weights > 1e-6  # the corners that take part; those of an edge or corner have one or two without weight
    on_face = off.all(axis=1)
    on_edge = off.sum(axis=1) == 2
    edge = 1 + (np.argmin(off, axis=1) + 1) % 3  # edge 12 lies opposite corner 0
    feature = np.where(on_face, 0, np.where(on_edge, edge, 4 + np.argmax(off, axis=1)))
    normals: FloatArray = surface.normals[triangle, feature]
    return normals
