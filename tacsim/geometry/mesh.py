"""Closed triangle meshes from STL files: guarded loading, and the exact signed distance to their surface."""

from __future__ import annotations

import hashlib
import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from scipy.spatial import KDTree
    from trimesh import Trimesh

IntArray = NDArray[np.int64]
Axes = tuple[FloatArray, FloatArray, FloatArray]

MAX_BYTES = 64 * 2**20
_CHUNK = 500_000  # rows worked on at once, for memory
_REPAIR = (
    "repair it (for example Blender's 3D-Print Toolbox 'Make Manifold', or Meshmixer 'Inspector') and export again"
)


def file_fingerprint(path: str | Path) -> str:
    """SHA-256 of an STL file's bytes as they are now, by which to remember what was made of them.

    Raises FileNotFoundError; ValueError for what is no file, is not named .stl, is empty or larger than 64 MiB.
    """
    return hashlib.sha256(_read_stl(Path(path))).hexdigest()


def load_mesh(path: str | Path, scale: float, expected: str | None = None) -> Trimesh:
    """The closed mesh of an STL file (binary or text), vertices times `scale` [m per file unit].

    Triangles that face inwards all together are turned round. Surfaces that cut through themselves are not detected.

    Raises FileNotFoundError; ValueError for a file that is no STL, is larger than 64 MiB or 500,000 triangles, is
    truncated, whose fingerprint is not the one `expected`, or whose mesh is empty, not closed, degenerate, not finite
    or of absurd size.
    """
    path = Path(path)
    data = _read_stl(path)
    if expected is not None and hashlib.sha256(data).hexdigest() != expected:
        raise ValueError(f"{path}: the file was changed while it was read; try again")
    mesh = _decode_stl(data, path)
    _require_closed(mesh, scale, path)
    mesh.apply_scale(scale)  # type: ignore[no-untyped-call]
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _read_stl(path: Path) -> bytes:
    if path.suffix.lower() != ".stl":
        raise ValueError(f"{path}: is no STL file (its name ends in '{path.suffix}'); export the mesh as .stl")
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such mesh file; give the path of an .stl file")
    if not path.is_file():
        raise ValueError(f"{path}: is no file; give the path of an .stl file")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{path}: {size:,} bytes, the limit is {MAX_BYTES:,}; decimate the mesh or save as binary STL")
    if size == 0:
        raise ValueError(f"{path}: the file is empty; export the mesh again")
    return path.read_bytes()


def _decode_stl(data: bytes, path: Path) -> Trimesh:
    max_triangles = 500_000
    count = _count_triangles(data, path)
    if count == 0:
        raise ValueError(f"{path}: the mesh is empty (no triangles); export it again")
    if count > max_triangles:
        raise ValueError(f"{path}: {count:,} triangles, the limit is {max_triangles:,}; decimate the mesh")
    import trimesh

    try:
        with _silence_trimesh():
            loaded = trimesh.load_mesh(io.BytesIO(data), file_type="stl", process=False)
    except Exception as error:  # the decoder raises whatever its parser stumbles over
        raise ValueError(f"{path}: is no readable STL ({error}); export the mesh again") from error
    if len(loaded.faces) != count:
        raise ValueError(f"{path}: {count:,} triangles expected, {len(loaded.faces):,} read; export the mesh again")
    return trimesh.Trimesh(loaded.vertices, loaded.faces, process=False)  # without the normals that the file claims


@contextmanager
def _silence_trimesh() -> Iterator[None]:
    """Keeps trimesh off the terminal; numbers that its text parser would only warn of become errors."""
    logger = logging.getLogger("trimesh")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("error", DeprecationWarning)
            yield
    finally:
        logger.setLevel(level)


def _count_triangles(data: bytes, path: Path) -> int:
    """Triangles of an STL file, from its structure alone. Binary files may begin with "solid": the length decides."""
    header_size, record_size = 84, 50  # bytes of a binary STL: header with the count, one triangle
    stated = int.from_bytes(data[80:header_size], "little") if len(data) >= header_size else None
    if stated is not None and len(data) == header_size + record_size * stated:
        return stated
    lower = data.lower()
    if lower.lstrip().startswith(b"solid") and b"\0" not in data:
        starts, ends = lower.count(b"facet normal"), lower.count(b"endfacet")
        if starts != ends or lower.count(b"vertex") != 3 * starts or b"endsolid" not in lower:
            raise ValueError(
                f"{path}: text STL is truncated ({starts} facets begin, {ends} end); export the mesh again"
            )
        return starts
    if stated is None or b"\0" not in data:
        raise ValueError(
            f"{path}: is no STL (neither a binary header nor 'solid' at the start); export the mesh as .stl"
        )
    expected = header_size + record_size * stated
    raise ValueError(
        f"{path}: binary STL of {stated:,} triangles should have {expected:,} bytes but has {len(data):,} "
        f"({'truncated' if len(data) < expected else 'too long'}); export or copy the mesh again"
    )


def _require_closed(mesh: Trimesh, scale: float, path: Path) -> None:
    """Merges the corners that STL repeats, then refuses what has no well-defined inside. Coordinates in file units."""
    resolution = 1e-7  # of float32, the number format of STL: what is thinner, relative to the mesh, has no area
    sizes = (1e-5, 1.0)  # smallest and largest edge of the bounding box [m]
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices).all(axis=1)).sum())
        raise ValueError(f"{path}: {bad} corners are not finite (NaN or infinite); {_REPAIR}")
    size = np.ptp(mesh.vertices, axis=0)
    smallest, largest = sizes
    if size.min() * scale < smallest or size.max() * scale > largest:
        raise ValueError(
            f"{path}: the mesh measures {' x '.join(f'{s * scale:.3g}' for s in size)} m at scale {scale:g} m per file "
            f"unit; allowed are {smallest:g} to {largest:g} m. Is the scale right (0.001 for mm) and the mesh a solid?"
        )
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    collapsed = (mesh.faces == np.roll(mesh.faces, 1, axis=1)).any(axis=1)  # two corners the same: harmless, a line
    mesh.update_faces(~collapsed)
    if not mesh.is_watertight:
        _, uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        wrong = int((uses != 2).sum())
        raise ValueError(f"{path}: the mesh is not closed ({wrong} edges do not join exactly two triangles); {_REPAIR}")
    if not mesh.is_winding_consistent:
        raise ValueError(f"{path}: neighbouring triangles face opposite ways; recalculate the normals, or {_REPAIR}")
    edges = np.diff(mesh.triangles[:, [0, 1, 2, 0]], axis=1)
    height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / np.linalg.norm(edges, axis=2).max(axis=1)
    degenerate = int((height < resolution * size.max()).sum())
    if degenerate:
        raise ValueError(f"{path}: {degenerate} triangles are degenerate (three corners on a line); {_REPAIR}")
    if abs(mesh.volume) < resolution * size.prod():
        raise ValueError(f"{path}: the mesh encloses no volume; model a solid and export again")


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
    """`mesh`: closed and consistently wound, as :func:`load_mesh` gives it; cut into `pieces` or a few times more."""
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
