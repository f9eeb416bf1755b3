"""The objects of a press set, by name: the mesh files of a folder, or twenty shapes that come with tacsim: balls,
boxes, cylinders, and closed meshes made of an outline and a profile; 3 to 9 mm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from tacsim.geometry.mesh_file import SUFFIXES, load_mesh
from tacsim.interface import FloatArray
from tacsim.models.scene import Box, Cylinder, Mesh, Shape, Sphere
from tacsim.models.text import printable_line
from tacsim.record.sources import visible_files

if TYPE_CHECKING:
    from trimesh import Trimesh

SHAPES = "shapes"  # the name of those that come with tacsim
FOLDER = "objects"  # of a set: its mesh files


def find_objects(source: str, scale: float | None) -> tuple[dict[str, Shape], dict[str, bytes]]:
    """Objects by name, in the order of their names, and their mesh files; paths of meshes are in the set's folder.

    Args:
        source: "shapes", or a folder of mesh files.
        scale: metres per unit of the mesh files; None: guessed for each file.

    Raises:
        ValueError: `source` is no folder, has no mesh files, or has damaged ones; the message names all of them.
    """
    if source == SHAPES:
        made: dict[str, Any] = {name: mesh.export(file_type="stl") for name, mesh in make_meshes().items()}
        found: dict[str, Shape] = {**CLOSED_FORMS, **{name: Mesh(path=_mesh_path(name), scale=1e-3) for name in made}}
        return {name: found[name] for name in sorted(found)}, {_mesh_path(name): data for name, data in made.items()}
    folder = Path(source)
    if not folder.is_dir():
        raise ValueError(f"--objects {source} is not a folder; give a folder of mesh files, or 'shapes'")
    paths = sorted(path for path in visible_files(folder, SUFFIXES) if path.is_file())
    if not paths:
        known = ", ".join(SUFFIXES)
        raise ValueError(
            f"{folder} holds no mesh file ({known}; folders in it are not searched); give another, or 'shapes'"
        )
    problems, scales = [], {}
    for path in paths:
        try:
            scales[path] = float(load_mesh(path, scale).metadata["scale"])
        except (ValueError, OSError) as failure:
            problems.append(str(failure))
    stems = [path.stem for path in paths]
    problems += [f"{folder}: two files are called {stem}" for stem in sorted({s for s in stems if stems.count(s) > 1})]
    problems += [
        f"{printable_line(str(path))}: the name of an object must be readable; rename the file"
        for path in paths
        if not path.stem.isprintable() or not path.stem.strip()
    ]
    if problems:
        raise ValueError("\n".join(problems))
    return (
        {path.stem: Mesh(path=_mesh_path(path.stem, path.suffix), scale=scales[path]) for path in paths},
        {_mesh_path(path.stem, path.suffix): path.read_bytes() for path in paths},
    )


def _mesh_path(name: str, suffix: str = ".stl") -> str:
    return f"{FOLDER}/{name}{suffix.lower()}"


CLOSED_FORMS: dict[str, Sphere | Cylinder | Box] = {
    "ball-3": Sphere(radius=3e-3),
    "ball-6": Sphere(radius=6e-3),
    "puck": Cylinder(radius=3e-3, height=4e-3),
    "pin": Cylinder(radius=1.2e-3, height=4e-3),
    "cube": Box(size=(5e-3, 5e-3, 5e-3)),
    "bar": Box(size=(9e-3, 2.5e-3, 4e-3)),
    "brick": Box(size=(7e-3, 4e-3, 4e-3)),
}


def make_meshes() -> dict[str, Trimesh]:
    """Meshes by name, in mm. Their lower side presses the gel."""
    sides = 64  # corners of a circle
    from trimesh import creation, transformations

    lying = transformations.rotation_matrix(np.pi / 2, [0, 1, 0])  # type: ignore[no-untyped-call]
    made: dict[str, Callable[[], Trimesh]] = {
        "cone": lambda: _loft_outline(_polygon(sides, 3.0), [(0.25, 0.0), (0.3, 0.1), (1.0, 3.0), (1.0, 4.0)]),
        "pyramid": lambda: _loft_outline(_polygon(4, 3.5), [(0.25, 0.0), (0.3, 0.12), (1.0, 3.0), (1.0, 4.0)]),
        "hexagon": lambda: _prism(_polygon(6, 3.0)),
        "triangle": lambda: _prism(_polygon(3, 3.5)),
        "star": lambda: _prism(_star(5, 4.0, 1.8)),
        "gear": lambda: _prism(_gear(8, 3.8, 2.8)),
        "cross": lambda: _prism(_cross(3.5, 1.0)),
        "egg": lambda: _loft_outline(_polygon(sides, 1.0) * [2.2, 3.2], _ellipsoid_profile(2.0)),
        "roof": lambda: _roof(8.0, 4.0, 3.0, 0.4),
        "capsule": lambda: creation.capsule(4.0, 1.6, [32, 32], transform=lying),
        "torus": lambda: creation.torus(3.0, 1.0, sides, 32),
        "bars": lambda: _join_meshes([_move_mesh(_prism(_rectangle(0.6, 3.5)), x, 0.0) for x in (-2.4, 0.0, 2.4)]),
        "dots": lambda: _join_meshes(
            [_move_mesh(creation.icosphere(3, 1.1), x, y) for x in (-1.6, 1.6) for y in (-1.6, 1.6)]
        ),
    }  # fmt: skip
    return {name: make() for name, make in made.items()}


def _polygon(corners: int, radius: float) -> FloatArray:
    """Corners (n, 2) of a regular polygon, the first on the x axis."""
    angles = 2 * np.pi * np.arange(corners) / corners
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


def _star(points: int, outer: float, inner: float) -> FloatArray:
    return _polygon(2 * points, 1.0) * np.where(np.arange(2 * points) % 2, inner, outer)[:, None]


def _gear(teeth: int, outer: float, inner: float) -> FloatArray:
    """Each tooth is as wide as a gap."""
    radii = np.where(np.arange(4 * teeth) % 4 < 2, outer, inner)
    return _polygon(4 * teeth, 1.0) * radii[:, None]


def _cross(length: float, half: float) -> FloatArray:
    arm = np.array([[length, -half], [length, half], [half, half]])
    turns = [np.array([[c, -s], [s, c]]) for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))]
    return np.concatenate([arm @ turn.T for turn in turns])


def _rectangle(half_x: float, half_y: float) -> FloatArray:
    return np.array([[half_x, -half_y], [half_x, half_y], [-half_x, half_y], [-half_x, -half_y]])


def _ellipsoid_profile(half: float) -> list[tuple[float, float]]:
    """Profile of an ellipsoid: scale and height."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 34)[1:-1]
    return [(float(np.cos(angle)), half * float(np.sin(angle))) for angle in angles]


def _prism(outline: FloatArray) -> Trimesh:
    """A prism 4 mm high with a bevelled lower edge: a sharp edge of a sliding mesh would catch the gel."""
    bevel = 0.3  # [mm]
    narrow = 1.0 - bevel / float(np.linalg.norm(outline, axis=1).max())
    return _loft_outline(outline, [(narrow, 0.0), (1.0, bevel), (1.0, 4.0)])


def _roof(length: float, width: float, height: float, ridge: float) -> Trimesh:
    """A roof whose ridge points down and lies along x, `ridge` wide."""
    low, high = _rectangle(length / 2, ridge / 2), _rectangle(length / 2, width / 2)
    return _close_surface([np.append(each, np.full((4, 1), z), axis=1) for each, z in ((low, 0.0), (high, height))])


def _loft_outline(outline: FloatArray, profile: Sequence[tuple[float, float]]) -> Trimesh:
    """The outline (n, 2), star-shaped about its origin, scaled at each height by `profile` (scale, z)."""
    return _close_surface([np.append(scale * outline, np.full((len(outline), 1), z), axis=1) for scale, z in profile])


def _close_surface(rings: Sequence[FloatArray]) -> Trimesh:
    """The closed surface through rings of corners (n, 3), lowest first, with a centre point in the first and last."""
    from trimesh import Trimesh

    count, last = len(rings[0]), len(rings) - 1
    at, after = np.arange(count), (np.arange(count) + 1) % count
    bottom, top = count * len(rings), count * len(rings) + 1
    faces = [np.stack([after, at, np.full(count, bottom)], axis=1)]
    for ring in range(last):
        a, b = ring * count + at, ring * count + after
        faces += [np.stack([a, b, b + count], axis=1), np.stack([a, b + count, a + count], axis=1)]
    faces.append(np.stack([last * count + at, last * count + after, np.full(count, top)], axis=1))
    middles = [rings[0].mean(axis=0), rings[-1].mean(axis=0)]
    return Trimesh(np.concatenate([*rings, middles]), np.concatenate(faces), process=False)


def _move_mesh(mesh: Trimesh, x: float, y: float) -> Trimesh:
    mesh.apply_translation([x, y, 0.0])
    return mesh


def _join_meshes(parts: Sequence[Trimesh]) -> Trimesh:
    from trimesh.util import concatenate

    whole: Any = concatenate(list(parts))
    return cast("Trimesh", whole)
