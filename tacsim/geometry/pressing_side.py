"""Which side of an indenter presses on the gel: in words, and as a section."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tacsim.geometry.shapes import centred_mesh
from tacsim.interface import FloatArray, Pose
from tacsim.models.scene import Box, Cylinder, Indenter, Mesh, Shape, Sphere
from tacsim.pose import inverse, rotate, rotation_matrix

if TYPE_CHECKING:
    from trimesh import Trimesh

AXIS_TOLERANCE = math.radians(1.0)  # a direction within it of an axis is called by that axis
SIDES = {"-z": (0.0, 0.0), "+z": (math.pi, 0.0), "+x": (0.0, math.pi / 2), "-x": (0.0, -math.pi / 2),
         "+y": (-math.pi / 2, 0.0), "-y": (math.pi / 2, 0.0)}  # fmt: skip
# ^ by the side that is to press: roll and pitch of the indenter [rad]


@dataclass(frozen=True, slots=True)
class PressingSide:
    """The side of an indenter that faces the gel."""

    name: str  # of the direction that is down, in the indenter's own axes: "-z", or the vector
    lowest: str  # what is there: "a flat face of 6 x 6 mm", "an edge 6 mm long", "a point"
    lowest_point: FloatArray  # (3,) the middle of that, in the indenter's own axes [m]


def find_pressing_side(indenter: Indenter) -> PressingSide:
    """Of an indenter as its scene turns it. Raises what :func:`tacsim.geometry.mesh_file.load_mesh` raises."""
    level_share = 1e-4  # of the height: corners within it of the lowest are level with it
    pose = Pose(quaternion=indenter.turn)
    down = rotate(inverse(pose), [0.0, 0.0, -1.0])
    mesh = surface_mesh(indenter.geometry)
    vertices = np.asarray(mesh.vertices, np.float64) @ rotation_matrix(pose).T
    height = float(np.ptp(vertices[:, 2]))
    low = vertices[:, 2] <= vertices[:, 2].min() + level_share * height
    part = vertices[low]
    size = np.sort(np.ptp(part[:, :2], axis=0))[::-1] * 1e3
    flat = bool(low[np.asarray(mesh.faces)].all(axis=1).any())
    if isinstance(indenter.geometry, Sphere):
        words = "a ball"
    elif flat:
        words = f"a flat face of {size[0]:.3g} x {size[1]:.3g} mm"
    elif len(part) > 1 and np.hypot(*size) > 1e3 * level_share * height:
        words = f"an edge {np.hypot(*size):.3g} mm long"
    else:
        words = "a point"
    middle = rotate(inverse(pose), (part.min(axis=0) + part.max(axis=0)) / 2)
    return PressingSide(_direction_name(down), words, np.asarray(middle))


def describe_side(indenter: Indenter) -> str:
    """One line: "-z of cone.stl, a flat face of 6 x 6 mm"."""
    side, geometry = find_pressing_side(indenter), indenter.geometry
    name = Path(geometry.path).name if isinstance(geometry, Mesh) else f"the {geometry.shape}"
    return f"{side.name} of {name}, {side.lowest}"


def section_lines(geometry: Shape, pose: Pose, axis: int, at: float) -> FloatArray:
    """Where the surface of a shape at `pose` cuts the plane x = `at` (axis 0) or y = `at` (axis 1) [m]: straight lines
    (n, 2, 3), in no order [m]."""
    from trimesh.intersections import mesh_plane

    mesh = surface_mesh(geometry)
    mesh.vertices = np.asarray(mesh.vertices) @ rotation_matrix(pose).T + pose.position
    normal = np.eye(3)[axis]
    lines = mesh_plane(mesh, normal, at * normal)  # type: ignore[no-untyped-call]
    return np.asarray(lines, np.float64).reshape(-1, 2, 3)


def surface_mesh(geometry: Shape) -> Trimesh:
    """A closed mesh [m] in the shape's own frame; of a ball or a cylinder a fine approximation."""
    from trimesh import creation

    made: Trimesh
    match geometry:
        case Box():
            made = creation.box(geometry.size)
        case Sphere():
            made = creation.icosphere(4, geometry.radius)
        case Cylinder():
            made = creation.cylinder(geometry.radius, geometry.height, sections=128)
        case Mesh():
            made = centred_mesh(geometry)
    return made


def _direction_name(down: FloatArray) -> str:
    axis = int(np.argmax(np.abs(down)))
    if abs(down[axis]) >= math.cos(AXIS_TOLERANCE):
        return f"{'-' if down[axis] < 0 else '+'}{'xyz'[axis]}"
    return f"({', '.join(f'{value:.2f}' for value in down)})"
