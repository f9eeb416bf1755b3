"""Closed triangle meshes from STL, OBJ and PLY files: guarded reading, units, and repairs on request (superfluous
triangles are dropped, holes closed, triangles turned outwards)."""

from __future__ import annotations

import hashlib
import io
import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray
from tacsim.models.text import suggest_file

if TYPE_CHECKING:
    from trimesh import Trimesh

SUFFIXES = (".stl", ".obj", ".ply")
MAX_BYTES = 64 * 2**20
MAX_TRIANGLES = 500_000
UNITS = {1.0: "metres", 1e-3: "millimetres"}  # of a file, by the scale that is guessed
_REPAIR = (
    "give it `repair: true` (tacsim press: --repair), or repair it with a mesh program (for example Blender's 3D-Print "
    "Toolbox, 'Make Manifold') and export again"
)


def file_fingerprint(path: str | Path) -> str:
    """SHA-256 of a mesh file's bytes as they are now, by which to remember what was made of them.

    Raises FileNotFoundError; ValueError for what is no file, has none of SUFFIXES, is empty or larger than 64 MiB.
    """
    return hashlib.sha256(_read_bytes(Path(path))).hexdigest()


def load_mesh(path: str | Path, scale: float | None, expected: str | None = None, repair: bool = False) -> Trimesh:
    """The closed mesh [m] of a file.

    Args:
        path: STL (binary or text), OBJ, or PLY (binary or text); polygons become triangles, textures are ignored.
        scale: metres per unit of the file; None: :func:`guess_scale`.
        expected: the file's fingerprint, if it must have that.
        repair: closes holes and turns triangles round (:func:`tacsim.geometry.mesh_file.repair_mesh`).

    Returns:
        The mesh; `metadata` holds `scale` (float) and `repairs` (list of texts; empty if nothing was repaired).
        Triangles that all face inwards are turned round. Surfaces that cut through themselves are not detected.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file has another format, is larger than 64 MiB or 500,000 triangles, is truncated or changed, or
            its mesh is empty, not closed, degenerate, not finite, or of absurd size.
    """
    path = Path(path)
    data = _read_bytes(path)
    if expected is not None and hashlib.sha256(data).hexdigest() != expected:
        raise ValueError(f"{path}: the file was changed while it was read; try again")
    mesh = _decode(data, path)
    if scale is None:
        scale = guess_scale(np.ptp(mesh.vertices, axis=0).max()) if np.isfinite(mesh.vertices).all() else 1e-3
    _require_size(mesh, scale, path)
    _merge_corners(mesh)
    repairs = []
    if repair:
        try:
            repairs = repair_mesh(mesh, scale)
        except ValueError as failure:
            raise ValueError(f"{path}: cannot be repaired: {failure}") from None
    _require_closed(mesh, path)
    mesh.apply_scale(scale)  # type: ignore[no-untyped-call]
    if mesh.volume < 0:
        mesh.invert()
    mesh.metadata = {"scale": scale, "repairs": repairs}
    return mesh


def guess_scale(largest_side: float) -> float:
    """Metres per unit of a file whose mesh has this largest side [file units]: 1 below one unit, otherwise 0.001.

    Mesh files carry no unit. Programs for mechanical parts write millimetres, those for robots metres, and what a
    tactile sensor touches is between a millimetre and a metre large.
    """
    return 1.0 if largest_side < 1.0 else 1e-3


def describe_file(mesh: Trimesh, scale: float | None) -> list[str]:
    """What was assumed and repaired in a mesh of :func:`load_mesh`, a sentence each.

    scale: as it was given; None: the unit was guessed.
    """
    words = []
    if scale is None:
        size = " x ".join(f"{side * 1e3:.3g}" for side in mesh.extents)
        unit = UNITS[mesh.metadata["scale"]]
        words.append(f"read in {unit}, guessed from its size ({size} mm); `scale` sets another unit")
    return [*words, *mesh.metadata["repairs"]]


def _read_bytes(path: Path) -> bytes:
    if path.suffix.lower() not in SUFFIXES:
        known = ", ".join(SUFFIXES)
        raise ValueError(f"{path}: is no mesh file that is read here (its name ends in '{path.suffix}'); use {known}")
    if not path.exists():
        raise FileNotFoundError(
            f"{path}: no such mesh file{suggest_file(path, SUFFIXES)}; give the path of a file that ends in "
            f"{', '.join(SUFFIXES)}"
        )
    if not path.is_file():
        raise ValueError(f"{path}: is no file; give the path of a mesh file")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ValueError(f"{path}: {size:,} bytes, the limit is {MAX_BYTES:,}; decimate the mesh or save as binary STL")
    if size == 0:
        raise ValueError(f"{path}: the file is empty; export the mesh again")
    return path.read_bytes()


def _decode(data: bytes, path: Path) -> Trimesh:
    """The mesh as it is in the file, without the normals that the file claims."""
    kind = path.suffix.lower()[1:]
    min_corners, stated = {"stl": _count_stl, "obj": _count_obj, "ply": _count_ply}[kind](data, path)
    if stated == 0:
        raise ValueError(f"{path}: the mesh is empty (no triangles; a cloud of points?); export a closed surface")
    _require_few(stated, path)
    import trimesh

    options = {"skip_materials": True} if kind == "obj" else {}
    try:
        with _silence_trimesh():
            loaded = trimesh.load_mesh(io.BytesIO(data), file_type=kind, process=False, **options)
            corners, faces = np.asarray(loaded.vertices, np.float64), np.asarray(loaded.faces, np.int64)
    except Exception as error:  # the decoder raises whatever its parser stumbles over
        raise ValueError(f"{path}: is no readable {kind.upper()} ({error}); export the mesh again") from error
    # A polygon of n corners becomes n - 2 triangles, so that polygons are at most as many as triangles.
    if len(faces) < stated or (kind == "stl" and len(faces) > stated) or len(corners) < min_corners:
        raise ValueError(f"{path}: {stated:,} faces expected, {len(faces):,} read; export the mesh again")
    _require_few(len(faces), path)
    if faces.min() < 0 or faces.max() >= len(corners):
        raise ValueError(f"{path}: a face names a corner that is not in the file; export the mesh again")
    return trimesh.Trimesh(corners, faces, process=False)


def _require_few(count: int, path: Path) -> None:
    if count > MAX_TRIANGLES:
        raise ValueError(f"{path}: {count:,} triangles, the limit is {MAX_TRIANGLES:,}; decimate the mesh")


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


def _count_stl(data: bytes, path: Path) -> tuple[int, int]:
    """Least corners and triangles of an STL file, from its structure alone. Binary files may begin with "solid": the
    length decides."""
    header_size, record_size = 84, 50  # bytes of a binary STL: header with the count, one triangle
    stated = int.from_bytes(data[80:header_size], "little") if len(data) >= header_size else None
    if stated is not None and len(data) == header_size + record_size * stated:
        return 0, stated
    lower = data.lower()
    if lower.lstrip().startswith(b"solid") and b"\0" not in data:
        starts, ends = lower.count(b"facet normal"), lower.count(b"endfacet")
        if starts != ends or lower.count(b"vertex") != 3 * starts or b"endsolid" not in lower:
            raise ValueError(
                f"{path}: text STL is truncated ({starts} facets begin, {ends} end); export the mesh again"
            )
        return 0, starts
    if stated is None or b"\0" not in data:
        raise ValueError(
            f"{path}: is no STL (neither a binary header nor 'solid' at the start); export the mesh as .stl"
        )
    expected = header_size + record_size * stated
    raise ValueError(
        f"{path}: binary STL of {stated:,} triangles should have {expected:,} bytes but has {len(data):,} "
        f"({'truncated' if len(data) < expected else 'too long'}); export or copy the mesh again"
    )


def _count_obj(data: bytes, path: Path) -> tuple[int, int]:
    """Least corners and faces of an OBJ file: its lines `f`. Corners without a face are dropped by the decoder."""
    if b"\0" in data:
        raise ValueError(f"{path}: is no OBJ (it is not a text file); export the mesh as .obj")
    faces = re.findall(rb"^[ \t]*f[ \t]+\S", data, re.MULTILINE)
    return 0, len(faces)


def _count_ply(data: bytes, path: Path) -> tuple[int, int]:
    """Corners and faces that the header of a PLY file states."""
    header, end, _ = data.partition(b"end_header")
    if not data.startswith(b"ply") or not end:
        raise ValueError(f"{path}: is no PLY (its header does not begin with 'ply' and end); export the mesh as .ply")
    stated = {
        name: int(count)
        for name, count in re.findall(rb"^element[ \t]+(\w+)[ \t]+(\d{1,18})[ \t]*\r?$", header, re.MULTILINE)
    }
    return stated.get(b"vertex", 0), stated.get(b"face", 0)


def _require_size(mesh: Trimesh, scale: float, path: Path) -> None:
    """Refuses corners that are no numbers, and a mesh that nothing could touch. Coordinates in file units."""
    smallest, largest = 1e-5, 1.0  # edge of the bounding box [m]
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices).all(axis=1)).sum())
        raise ValueError(f"{path}: {bad} corners are not finite (NaN or infinite); {_REPAIR}")
    size = np.ptp(mesh.vertices, axis=0)
    if size.min() * scale < smallest or size.max() * scale > largest:
        raise ValueError(
            f"{path}: the mesh measures {' x '.join(f'{s * scale:.3g}' for s in size)} m at scale {scale:g} m per file "
            f"unit; allowed are {smallest:g} to {largest:g} m. Is the scale right (0.001 for mm) and the mesh a solid?"
        )


def _merge_corners(mesh: Trimesh) -> None:
    """Merges corners that the file repeats, and drops triangles that this leaves with two equal corners."""
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    collapsed = (mesh.faces == np.roll(mesh.faces, 1, axis=1)).any(axis=1)
    mesh.update_faces(~collapsed)


def _require_closed(mesh: Trimesh, path: Path) -> None:
    """Refuses what has no well-defined inside. Coordinates in file units."""
    resolution = 1e-7  # of float32, the number format of STL: what is thinner, relative to the mesh, has no area
    if not mesh.is_watertight:
        _, uses = np.unique(mesh.edges_sorted, axis=0, return_counts=True)
        wrong = int((uses != 2).sum())
        raise ValueError(f"{path}: the mesh is not closed ({wrong} edges do not join exactly two triangles); {_REPAIR}")
    if not mesh.is_winding_consistent:
        raise ValueError(f"{path}: neighbouring triangles face opposite ways; {_REPAIR}")
    edges = np.diff(mesh.triangles[:, [0, 1, 2, 0]], axis=1)
    height = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) / np.linalg.norm(edges, axis=2).max(axis=1)
    size = np.ptp(mesh.vertices, axis=0)
    degenerate = int((height < resolution * size.max()).sum())
    if degenerate:
        raise ValueError(f"{path}: {degenerate} triangles are degenerate (three corners on a line); {_REPAIR}")
    if abs(mesh.volume) < resolution * size.prod():
        raise ValueError(f"{path}: the mesh encloses no volume; model a solid and export again")


IntArray = NDArray[np.int64]


def repair_mesh(mesh: Trimesh, scale: float) -> list[str]:
    """Changes `mesh`, whose equal corners are merged, so that its surface is closed where that is possible.

    Duplicate triangles and those without area are removed, triangles that face the other side than their neighbours are
    reversed, and each hole is closed by triangles from its edges to its middle.

    Args:
        mesh: in file units.
        scale: metres per file unit, for the texts.

    Returns:
        What was done, a sentence each; empty if nothing was.

    Raises:
        ValueError: a hole cannot be closed so: its rim touches itself, or is not visible as a whole from its middle.
    """
    words = []
    before = len(mesh.faces)
    mesh.update_faces(mesh.unique_faces() & (mesh.area_faces > 0.0))
    if dropped := before - len(mesh.faces):
        words.append(f"duplicate or flat triangles removed: {dropped}")
    if not mesh.is_winding_consistent:
        turned = _find_turned(mesh)
        mesh.faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
        words.append(f"triangles reversed to match their neighbours: {int(turned.sum())}")
    rims = _find_rims(np.asarray(mesh.faces, np.int64))
    if rims:
        words.append(_close_holes(mesh, rims, scale))
    return words


def _find_turned(mesh: Trimesh) -> NDArray[np.bool_]:
    """Which triangles (m,) face the other side than most of those that they are connected with by edges."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    faces, pairs = np.asarray(mesh.faces, np.int64), np.asarray(mesh.face_adjacency, np.int64)
    edges = np.asarray(mesh.face_adjacency_edges, np.int64)
    # Of two neighbours that face the same side, one runs along the common edge and the other against it.
    forward = [_runs_along(faces[pairs[:, side]], edges) for side in (0, 1)]
    same_side = forward[0] != forward[1]
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(faces), len(faces))).tocsr()
    unlike = {(int(a), int(b)) for a, b in pairs[~same_side]}
    count, part = connected_components(graph, directed=False)
    turned = np.zeros(len(faces), bool)
    for number in range(count):
        members = np.flatnonzero(part == number)
        order, parent = breadth_first_order(graph, members[0], directed=False)
        for face in order[1:]:
            other = int(parent[face])
            turned[face] = turned[other] ^ (((other, int(face)) in unlike) or ((int(face), other) in unlike))
        if 2 * int(turned[members].sum()) > len(members):
            turned[members] = ~turned[members]
    return turned


def _runs_along(faces: IntArray, edges: IntArray) -> NDArray[np.bool_]:
    """Whether each triangle (n, 3) runs from the first to the second corner of its edge (n, 2)."""
    return np.asarray(((faces == edges[:, :1]) & (np.roll(faces, -1, axis=1) == edges[:, 1:])).any(axis=1))


def _find_rims(faces: IntArray) -> list[IntArray]:
    """The holes of a surface: corners along the rim of each, in the direction in which the missing triangles run."""
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    count = int(faces.max()) + 1
    key, opposite = edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0]
    rim = edges[~np.isin(key, opposite)]
    after = {int(b): int(a) for a, b in rim}  # against the direction of the triangle that is there
    if len(after) != len(rim):
        raise ValueError("the rims of two holes touch, or more than two triangles meet at an edge")
    rims = []
    while after:
        first, corner = next(iter(after.items()))
        del after[first]
        loop = [first]
        while corner != first:
            loop.append(corner)
            if corner not in after:
                raise ValueError("more than two triangles meet at an edge")
            corner = after.pop(corner)
        rims.append(np.array(loop, np.int64))
    return rims


def _close_holes(mesh: Trimesh, rims: list[IntArray], scale: float) -> str:
    """Adds the triangles from each rim to its middle, or the one triangle that is missing. Returns a sentence."""
    corners, faces = [np.asarray(mesh.vertices, np.float64)], [np.asarray(mesh.faces, np.int64)]
    count = len(corners[0])
    for rim in rims:
        if len(rim) == 3:
            faces.append(rim[None, :])
            continue
        middle = _middle_of_rim(corners[0][rim], scale)
        faces.append(np.stack([rim, np.roll(rim, -1), np.full(len(rim), count)], axis=1))
        corners.append(middle[None, :])
        count += 1
    mesh.vertices, mesh.faces = np.concatenate(corners), np.concatenate(faces)
    widths = [float(np.linalg.norm(np.ptp(corners[0][rim], axis=0))) * scale * 1e3 for rim in rims]
    return f"holes closed: {len(rims)}, the largest {max(widths):.3g} mm wide with {max(map(len, rims))} edges"


def _middle_of_rim(rim: FloatArray, scale: float) -> FloatArray:
    """Mean (3,) of the corners `rim` (n, 3) of a hole. Raises ValueError if the rim is not seen as a whole from it, in
    the plane that fits the rim best: triangles to it would then lie across each other."""
    middle = rim.mean(axis=0)
    spokes = rim - middle
    normal = np.cross(spokes, np.roll(spokes, -1, axis=0))
    total = normal.sum(axis=0)
    if not (normal @ total > 0.0).all():
        width = float(np.linalg.norm(np.ptp(rim, axis=0))) * scale * 1e3
        raise ValueError(
            f"the rim of a hole ({len(rim)} edges, {width:.3g} mm wide) is not visible as a whole from its middle; "
            "close it with a mesh program"
        )
    return np.asarray(middle)
