"""The objects of a press set, by name: the shapes that come with tacsim, or the mesh files of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from robot.collect.shapes import CLOSED_FORMS, make_meshes
from tacsim.geometry.mesh_file import SUFFIXES, load_mesh
from tacsim.models.scene import Mesh, Shape
from tacsim.models.text import printable_line
from tacsim.record.sources import visible_files

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
