"""Shapes of bodies, indenters and rigid objects, and how they are turned."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from tacsim.interface import FloatArray
from tacsim.models.quantity import Angle, Config, Length

Edge = Annotated[Length, Field(ge=1e-5, le=10.0)]  # of a body, an indenter or an object [m]


class Box(Config):
    shape: Literal["box"] = "box"
    size: tuple[Edge, Edge, Edge] = (10e-3, 10e-3, 10e-3)  # [m]


class Sphere(Config):
    shape: Literal["sphere"] = "sphere"
    radius: Edge = 5e-3  # [m]


class Cylinder(Config):
    """Upright cylinder: axis along z."""

    shape: Literal["cylinder"] = "cylinder"
    radius: Edge = 5e-3  # [m]
    height: Edge = 10e-3  # [m]


class Mesh(Config):
    """Closed triangle mesh of an STL, OBJ or PLY file."""

    shape: Literal["mesh"] = "mesh"
    path: str
    # [m per file unit]; None: 1 if the mesh's largest side is below one unit, otherwise 0.001
    scale: Annotated[float, Field(gt=0)] | None = None
    repair: bool = False  # close holes and turn triangles round


Shape = Annotated[Box | Sphere | Cylinder | Mesh, Field(discriminator="shape")]


def min_side(geometry: Box | Cylinder) -> float:
    """The shortest side [m]."""
    return min(geometry.size if isinstance(geometry, Box) else (2 * geometry.radius, geometry.height))


class Oriented(Config):
    """What may be turned: about world x by `roll`, then y by `pitch`, then z by `yaw`."""

    roll: Angle = 0.0
    pitch: Angle = 0.0
    yaw: Angle = 0.0

    @property
    def turn(self) -> FloatArray:
        """Its orientation in world as a quaternion (4,), x, y, z, w."""
        (sx, sy, sz), (cx, cy, cz) = (
            [of(angle / 2) for angle in (self.roll, self.pitch, self.yaw)] for of in (math.sin, math.cos)
        )
        return np.array([
            sx * cy * cz - cx * sy * sz, cx * sy * cz + sx * cy * sz,
            cx * cy * sz - sx * sy * cz, cx * cy * cz + sx * sy * sz,
        ])  # fmt: skip
