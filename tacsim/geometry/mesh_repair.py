"""Repair of a mesh that is not closed: superfluous triangles are dropped, holes closed, triangles turned outwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tacsim.interface import FloatArray

if TYPE_CHECKING:
    from trimesh import Trimesh

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
