"""Box, sphere, cylinder and mesh as geometry: body particles, and signed distance for rigid indenters.

Everything here is in the shape's own frame: axes as in the scene, origin at the centre of the bounding box.
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.geometry.mesh import distance_gradient, make_surface, signed_distance, signed_distance_on_grid
from tacsim.geometry.mesh_file import describe_file, file_fingerprint, load_mesh
from tacsim.interface import FloatArray, Pose
from tacsim.models.scene import Box, Cylinder, Indenter, Mesh, Scene, Shape, Sphere
from tacsim.models.text import millimetres
from tacsim.pose import inverse, rotate, rotation_matrix

if TYPE_CHECKING:
    from trimesh import Trimesh


MAX_PARTICLES = 5_000_000
MAX_NODES = 20_000_000
MIN_LAYERS = 3  # of particles: one has no height, and two cannot bulge
MAX_MISFIT = 0.1  # relative error of the size or the volume that the lattice of particles may have
LEVEL_SINE = 1e-5  # sine of an angle below which a direction is level with a face; float32 rotations are 1e-7 off
MIN_EDGE_ANGLE = math.radians(30.0)  # facets of what is drawn round meet at less
EXACT_BAND = 2  # grid spacings round a mesh in which the distance is exact


def bounding_size(geometry: Shape) -> FloatArray:
    """Size of the bounding box (3,) [m]. Raises what :func:`tacsim.geometry.mesh_file.load_mesh` raises."""
    match geometry:
        case Box():
            return np.array(geometry.size, dtype=np.float64)
        case Sphere():
            return np.full(3, 2 * geometry.radius)
        case Cylinder():
            return np.array([2 * geometry.radius, 2 * geometry.radius, geometry.height])
        case Mesh():
            return np.array(_mesh_extent(geometry, file_fingerprint(geometry.path)))


def farthest_point(geometry: Box | Sphere | Cylinder, direction: ArrayLike, edge_radius: float = 0.0) -> FloatArray:
    """The point (3,) [m] of a shape that lies farthest along `direction` (3,); of several, the middle of those.

    edge_radius: of the edges of a box or cylinder, rounded within its size [m]. A face or edge within LEVEL of square
    to the direction is square to it, for rounding must not choose a corner.
    """
    along = np.asarray(direction, dtype=np.float64)
    along = np.where(np.abs(along) > LEVEL_SINE * np.linalg.norm(along), along, 0.0)
    rounding = edge_radius * along / np.linalg.norm(along)
    match geometry:
        case Box():
            return np.asarray(np.sign(along) * (np.array(geometry.size) / 2 - edge_radius) + rounding)
        case Sphere():
            return np.asarray(geometry.radius * along / np.linalg.norm(along))
        case Cylinder():
            rim = (geometry.radius - edge_radius) * along[:2] / max(float(np.linalg.norm(along[:2])), 1e-12)
            return np.append(rim, np.sign(along[2]) * (geometry.height / 2 - edge_radius)) + rounding


def rotated_bounding_size(geometry: Shape, turn: ArrayLike) -> FloatArray:
    """Size (3,) [m] along world axes of a shape turned by the quaternion `turn` (4,). Raises as `bounding_size`."""
    quaternion = np.asarray(turn, dtype=np.float64)
    if not quaternion[:3].any():
        return bounding_size(geometry)
    axes = rotation_matrix(Pose(quaternion=quaternion))
    match geometry:
        case Box():
            return np.asarray(np.abs(axes) @ np.array(geometry.size))
        case Cylinder():
            along = np.abs(axes[:, 2])
            return geometry.height * along + 2 * geometry.radius * np.sqrt(np.maximum(1.0 - along**2, 0.0))
        case Sphere():
            return bounding_size(geometry)
        case Mesh():
            return np.asarray(np.ptp(np.asarray(centred_mesh(geometry).vertices) @ axes.T, axis=0))


def depth_below_centre(geometry: Shape, turn: ArrayLike, edge_radius: float = 0.0) -> float:
    """How far the lowest point of a shape turned by the quaternion `turn` (4,) is below the centre of its own bounding
    box [m]. edge_radius: of the edges of a box or cylinder, rounded within its size [m]."""
    quaternion = np.asarray(turn, dtype=np.float64)
    if not quaternion[:2].any():
        return float(bounding_size(geometry)[2]) / 2
    down = rotate(inverse(Pose(quaternion=quaternion)), [0.0, 0.0, -1.0])
    if isinstance(geometry, Mesh):
        return float((np.asarray(centred_mesh(geometry).vertices) @ down).max())
    return float(farthest_point(geometry, down, edge_radius) @ down)


def edge_radius(indenter: Indenter, element: float) -> float:
    """Of an indenter's sharpest edges, on a gel of such elements [m]; infinite where it has none. A mesh has some where
    two faces meet at more than SHARP, and they count as sharp, for they are as drawn."""
    if not isinstance(indenter.geometry, Mesh):
        return math.inf if isinstance(indenter.geometry, Sphere) else indenter.effective_edge_radius(element)
    return 0.0 if len(_sharp_edges(indenter.geometry, file_fingerprint(indenter.geometry.path))) else math.inf


def edge_points(geometry: Shape, spacing: float) -> FloatArray:
    """Points (n, 3) [m] on the edges that `edge_radius` rounds, `spacing` [m] apart at most; none of a ball."""
    match geometry:
        case Box():
            corners = (
                np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * bounding_size(geometry) / 2
            )
            pairs = [(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :] if (a != b).sum() == 1]
            return _points_on_lines(np.array(pairs), spacing)
        case Sphere():
            return np.empty((0, 3))
        case Cylinder():
            turns = np.linspace(0.0, 2 * np.pi, 1 + max(3, math.ceil(2 * np.pi * geometry.radius / spacing)))
            rim = geometry.radius * np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1)
            return np.concatenate([rim + [0.0, 0.0, side * geometry.height / 2] for side in (-1, 1)])
        case Mesh():
            return _points_on_lines(_sharp_edges(geometry, file_fingerprint(geometry.path)), spacing)


def _points_on_lines(pairs: FloatArray, spacing: float) -> FloatArray:
    """Points (n, 3) on straight lines from one place to another, (k, 2, 3), both of these among them."""
    if not len(pairs):
        return np.empty((0, 3))
    longest = float(np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1).max())
    shares = np.linspace(0.0, 1.0, 1 + max(1, math.ceil(longest / spacing)))[:, None, None]
    return np.asarray(pairs[:, 0] + shares * (pairs[:, 1] - pairs[:, 0])).reshape(-1, 3)


def enclosed_volume(geometry: Shape) -> float:
    """Enclosed volume [m^3]. Raises what :func:`tacsim.geometry.mesh_file.load_mesh` raises."""
    match geometry:
        case Box():
            return float(np.prod(geometry.size))
        case Sphere():
            return float(4.0 / 3.0 * np.pi * geometry.radius**3)
        case Cylinder():
            return float(np.pi * geometry.radius**2 * geometry.height)
        case Mesh():
            return float(centred_mesh(geometry).volume)


def lattice_particles(geometry: Shape, spacing: float) -> FloatArray:
    """Body particles (n, 3) [m] on a cubic lattice of `spacing` [m]; each stands for spacing^3 of material.

    Along each axis the lattice has the whole number of layers nearest to the shape's size and is centred; the first
    layer lies half a spacing inside the face. For particles without a lattice see :mod:`tacsim.geometry.sampling`.

    Raises ValueError when the lattice has fewer than MIN_LAYERS, misses the shape's size (or a mesh's volume) by
    more than 10 %, holds no particle, or more than 5,000,000; and what
    :func:`tacsim.geometry.mesh_file.load_mesh` raises.
    """
    size = bounding_size(geometry)
    estimate, lattice = enclosed_volume(geometry) / spacing**3, np.prod(size / spacing)
    if estimate > MAX_PARTICLES or lattice > MAX_NODES:
        raise ValueError(
            f"{_shape_name(geometry)} would need {estimate:,.0f} particles (on a lattice of {lattice:,.0f}) at a "
            f"spacing of {millimetres(spacing)}; the limit is {MAX_PARTICLES:,}: use a larger spacing or a smaller "
            "shape"
        )
    layers = _check_layers(geometry, size, spacing)
    axes = tuple((np.arange(n) - (n - 1) / 2) * spacing for n in layers)
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    if isinstance(geometry, Mesh):
        surface = make_surface(centred_mesh(geometry))
        inside = signed_distance_on_grid(surface, (axes[0], axes[1], axes[2]), 2 * spacing).ravel() <= 0
    else:
        inside = shape_distance(geometry, nodes) <= 0
    found: FloatArray = nodes[inside]
    if len(found) == 0:
        raise no_particle_error(geometry, spacing)
    misfit = len(found) / estimate - 1
    if isinstance(geometry, Mesh) and abs(misfit) > MAX_MISFIT:
        raise ValueError(
            f"{_shape_name(geometry)}: particles at a spacing of {millimetres(spacing)} miss its volume by "
            f"{misfit:+.0%} (limit {MAX_MISFIT:.0%}); parts are thinner than the spacing: use a smaller one"
        )
    return found


def no_particle_error(geometry: Shape, spacing: float) -> ValueError:
    return ValueError(
        f"{_shape_name(geometry)} holds no particle at a spacing of {millimetres(spacing)}; use a smaller spacing"
    )


def _check_layers(geometry: Shape, size: FloatArray, spacing: float) -> NDArray[np.int_]:
    """How many layers the lattice has along each axis (3,). Raises ValueError with a spacing that fits."""
    layers = np.rint(size / spacing).astype(int)
    if layers.min() < MIN_LAYERS:
        axis = int(np.argmin(size))
        found = (
            f"only {millimetres(size[axis])} along {'xyz'[axis]}, {size[axis] / spacing:.2g} layers of particles "
            f"{millimetres(spacing)} apart; a body needs {MIN_LAYERS}"
        )
    else:
        misfit = layers * spacing / size - 1
        axis = int(np.argmax(np.abs(misfit)))
        if abs(misfit[axis]) <= MAX_MISFIT + 1e-9:
            return layers
        found = (
            f"{millimetres(size[axis])} along {'xyz'[axis]}, but {layers[axis]} layers of particles "
            f"{millimetres(spacing)} apart make {millimetres(layers[axis] * spacing)} ({misfit[axis]:+.0%}, "
            f"limit {MAX_MISFIT:.0%})"
        )
    fits = max_fitting_spacing(size, spacing)
    finer = (
        f"a particle_spacing of {millimetres(fits)}, or "
        if enclosed_volume(geometry) / fits**3 <= MAX_PARTICLES
        else ""
    )
    raise ValueError(
        f"{_shape_name(geometry)} is {found}: choose {finer}a size that along each axis is a whole number of times "
        f"{millimetres(spacing)}, at least {MIN_LAYERS}"
    )


def max_fitting_spacing(size: FloatArray, spacing: float) -> float:
    """The largest spacing [m], of `spacing` and what cuts the shortest of the sides `size` (3,) [m] into whole layers,
    whose lattice has MIN_LAYERS along each and misses none by more than MAX_MISFIT. As it is printed: 4 digits."""
    shortest, fits = float(size.min()), spacing
    layers = max(MIN_LAYERS, math.ceil(shortest / spacing - 1e-9))
    while True:
        count = np.rint(size / fits)
        if count.min() >= MIN_LAYERS and float(np.abs(count * fits / size - 1).max()) <= MAX_MISFIT:
            return fits
        fits, layers = float(f"{shortest / layers * 1e3:.4g}") * 1e-3, layers + 1


def shape_distance(geometry: Shape, points: ArrayLike, edge_radius: float = 0.0) -> FloatArray:
    """Signed distance (n,) [m] of `points` (n, 3) [m] from the surface: exact, Euclidean, negative inside.

    edge_radius: of the edges of a box or cylinder, rounded within its size [m].

    Raises what :func:`tacsim.geometry.mesh_file.load_mesh` raises.
    """
    at = np.asarray(points, dtype=np.float64)
    match geometry:
        case Sphere():
            return np.asarray(np.linalg.norm(at, axis=1) - geometry.radius, dtype=np.float64)
        case Box():
            return _outside_and_inside(np.abs(at) - np.array(geometry.size) / 2 + edge_radius) - edge_radius
        case Cylinder():
            radial = np.hypot(at[:, 0], at[:, 1]) - geometry.radius
            beyond = np.stack([radial, np.abs(at[:, 2]) - geometry.height / 2], axis=1)
            return _outside_and_inside(beyond + edge_radius) - edge_radius
        case Mesh():
            return signed_distance(make_surface(centred_mesh(geometry)), at)


def outward_normals(geometry: Shape, points: ArrayLike) -> FloatArray:
    """Unit gradient (n, 3) [-] of the signed distance at `points` (n, 3) [m]: away from the nearest surface, inside.

    Where several parts of the surface are equally near it is their mean direction; zero where those cancel (a ball's
    centre). Raises what :func:`shape_distance` raises.
    """
    at = np.asarray(points, dtype=np.float64)
    if isinstance(geometry, Mesh):
        return distance_gradient(make_surface(centred_mesh(geometry)), at)
    step = 1e-6 * float(bounding_size(geometry).max())
    sides = [shape_distance(geometry, at + d) - shape_distance(geometry, at - d) for d in step * np.eye(3)]
    gradient = np.stack(sides, axis=1) / (2 * step)
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return np.where(length > 1e-3, gradient / np.maximum(length, 1e-3), 0.0)


def _outside_and_inside(beyond: FloatArray) -> FloatArray:
    """Distance from a convex product of intervals, from how far each coordinate (n, k) lies beyond its own."""
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
    return np.asarray(outside + np.minimum(beyond.max(axis=1), 0.0))


def centred_mesh(geometry: Mesh, expected: str | None = None) -> Trimesh:
    """A mesh [m] in the shape's own frame; `expected`: fingerprint of its file, by which what is made is remembered.

    Raises what :func:`tacsim.geometry.mesh_file.load_mesh` raises.
    """
    mesh = load_mesh(geometry.path, geometry.scale, expected, geometry.repair)
    mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def describe_meshes(scene: Scene) -> list[str]:
    """What was assumed about the mesh files of a scene and repaired in them, a sentence each.

    Raises what :func:`tacsim.geometry.mesh_file.load_mesh` raises.
    """
    parts = (scene.body, scene.indenter)
    meshes = [part.geometry for part in parts if part is not None and isinstance(part.geometry, Mesh)]
    return [
        f"{Path(mesh.path).name}: {words}"
        for mesh in meshes
        if mesh.scale is None or mesh.repair
        for words in describe_file(centred_mesh(mesh), mesh.scale)
    ]


@lru_cache(maxsize=64)
def _mesh_extent(geometry: Mesh, content: str) -> tuple[float, ...]:
    """Size of the bounding box (3,) [m]. content: fingerprint of the file."""
    return tuple(float(side) for side in centred_mesh(geometry, content).extents)


@lru_cache(maxsize=64)
def _sharp_edges(geometry: Mesh, content: str) -> FloatArray:
    """Ends (n, 2, 3) [m] of the edges that stick out where two faces of a mesh meet at more than SHARP."""
    min_edge_length = 10e-6  # [m] shorter edges of a file are what its float32 numbers made of a point
    mesh = centred_mesh(geometry, content)
    sharp = mesh.face_adjacency_convex & (mesh.face_adjacency_angles > MIN_EDGE_ANGLE)
    ends = np.asarray(mesh.vertices[mesh.face_adjacency_edges[sharp]], np.float64)
    return np.asarray(ends[np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) > min_edge_length])


def _shape_name(geometry: Shape) -> str:
    return f"mesh {geometry.path}" if isinstance(geometry, Mesh) else geometry.shape
