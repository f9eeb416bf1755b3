"""A rigid object that moves by itself, and what stands around it: MuJoCo moves and holds them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from tacsim.models.quantity import Config, Force, Length
from tacsim.models.shape import Box, Oriented, Shape

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

    geometry: Shape = Box()
    position: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)  # of its centre, world [m]
    friction: Coefficient = 0.4
