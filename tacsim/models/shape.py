"""Shapes of bodies, indenters and rigid objects, and how they are turned; rigid objects that move by themselves, and
what stands around them: MuJoCo moves and holds them."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from tacsim.interface import FloatArray
from tacsim.models.quantity import Angle, Config, Force, Length

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


class Socket(Config):
    """A block with a rectangular hole along z, open at both ends. Its frame is in the middle of the hole's mouth, z out
    of it."""

    shape: Literal["socket"] = "socket"
    opening: tuple[Edge, Edge] = (10.5e-3, 10.5e-3)  # of the hole, x and y [m]
    depth: Edge = 15e-3  # of the block and its hole [m]
    wall: Edge = 10e-3  # of the block on each side of the hole [m]

    def walls(self) -> list[tuple[FloatArray, Box]]:
        """The four boxes that it consists of, each after its centre (3,) in the frame of the socket [m]."""
        (x, y), wall, depth = self.opening, self.wall, self.depth
        along_y, along_x = Box(size=(wall, y + 2 * wall, depth)), Box(size=(x, wall, depth))
        return [
            (np.array([sign * place, 0.0, -depth / 2])[[axis, 1 - axis, 2]], box)
            for axis, place, box in ((0, (x + wall) / 2, along_y), (1, (y + wall) / 2, along_x))
            for sign in (-1.0, 1.0)
        ]


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


Coefficient = Annotated[float, Field(ge=0, le=5)]
Coordinate = Annotated[Length, Field(ge=-10, le=10)]  # world [m]


class Guide(Config):
    """An object that slides along one line only, as a drawer does."""

    axis: Literal["x", "y", "z"] = "x"  # of world
    travel: Annotated[Length, Field(gt=0, le=10)] = 0.1  # from where it begins, one way [m]
    friction: Annotated[Force, Field(ge=0)] = 0.0  # that resists it, however it is loaded [N]
    damping: Annotated[float, Field(ge=0)] = 1.0  # [N s/m]


class RigidObject(Oriented):
    """A rigid object between the fingers of a gripper. It begins at rest: on the table, or on a pedestal, which is
    taken away once it is gripped."""

    geometry: Shape = Box(size=(20e-3, 14e-3, 16e-3))
    mass: Annotated[float, Field(ge=1e-4, le=100)] = 0.1  # evenly spread [kg]
    friction: Coefficient = 0.6  # Coulomb coefficient between object and gels
    table_friction: Coefficient = 0.4  # between object and table, pedestal or fixture: the larger of both counts
    position: tuple[Coordinate, Coordinate] = (0.0, 0.0)  # of its centre at the start, world x, y [m]
    # It stands so high above the table (z = 0), on a pedestal narrower than itself; 0: on the table [m]
    pedestal: Annotated[Length, Field(ge=0, le=2)] = 0.0
    # Where a gripper begins around it: the middle between its pads, from the object's centre, along world axes [m]
    grip: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    lift: Annotated[Length, Field(ge=0, le=1)] = 0.0  # a reset lifts it so far, once it is gripped [m]
    guide: Guide | None = None  # None: it moves freely


class Fixture(Oriented):
    """What stands in the scene and never moves."""

    geometry: Annotated[Box | Sphere | Cylinder | Mesh | Socket, Field(discriminator="shape")] = Box()
    # Of its centre, of a socket of its mouth, world [m]
    position: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)
    friction: Coefficient = 0.4
