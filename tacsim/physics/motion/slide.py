"""How an indenter with friction is slid over a gel: what makes it go slower, and what no default speed can follow.

Contact that slips keeps the shear that a motion leaves in it. Why each of these: docs/physics.md, "Controller".
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tacsim.models.tuning import MIN_EDGE_RADIUS
from tacsim.physics.motion.tuning import (
    DEEP_WITH_EDGES,
    DEEP_WITHOUT_EDGES,
    LIFTING_SPEED,
    MAX_CAUGHT_SLIDE,
    MAX_DEEP_SLIDE_LENGTH,
    MAX_SLIDE_LENGTH,
    MAX_SLIDE_SHEAR_MACH,
    MAX_SNAP_FRICTION,
    ROUNDING,
    STEEP_FRICTION,
    TURNING_SPEED_RANGE,
    WALL_SNAP_FRICTION,
)


def growth(way: NDArray[np.float64]) -> float:
    """0 to 1: how far an indenter is pressed into a gel while it goes `way` (3,), in the sensor's axes: 1 where it
    comes deeper by a quarter of what it is slid, or more."""
    slid = math.hypot(way[0], way[1])
    return min(1.0, float(-4.0 * way[2] / slid)) if way[2] < 0.0 < slid else 0.0


def turn(way: NDArray[np.float64], force: NDArray[np.float64], friction: float) -> float:
    """0 to 1: what share of the drag that friction allows lies across the `way` (3,) that an indenter goes; `force`
    (3,) on the sensor [N]; both in its axes."""
    slid, limit = math.hypot(way[0], way[1]), friction * abs(force[2])
    if slid <= ROUNDING * abs(way[2]) or limit == 0.0:
        return 0.0
    return float(min(1.0, abs(force[0] * way[1] - force[1] * way[0]) / (limit * slid)))


def release(way: NDArray[np.float64], force: NDArray[np.float64], friction: float) -> float:
    """0 to 1: what share of the drag that friction allows is there, on the `force` (3,) on the sensor [N], while the
    `way` (3,) of the indenter lifts it off; both in the sensor's axes."""
    limit = friction * abs(force[2])
    if way[2] <= 0.0 or limit == 0.0:
        return 0.0
    return float(min(1.0, math.hypot(force[0], force[1]) / limit) * way[2] / np.linalg.norm(way))


def pace(way: NDArray[np.float64], force: NDArray[np.float64], friction: float) -> float:
    """Share of the default speed at which an indenter goes the `way` (3,), so that it ends as a slow one; `force` (3,)
    on the sensor [N], both in its axes."""
    slowest, fastest = TURNING_SPEED_RANGE
    share = 1.0 - turn(way, force, friction) * (1.0 - min(max(friction, slowest), fastest))
    return share * (1.0 - release(way, force, friction) * (1.0 - LIFTING_SPEED))


def slower_walls(way: NDArray[np.float64], friction: float, mesh: float) -> float:
    """How many times slower the last of the `way` (3,) of an indenter is, if its edges reach the gel, so that it ends
    as a slow one. mesh: size of an element over the gel's thickness."""
    length = float(np.linalg.norm(way))
    along = math.hypot(way[0], way[1]) / length if length > 0.0 else 0.0
    return 1.0 + along * max(0.0, min(friction, MAX_SNAP_FRICTION) / (WALL_SNAP_FRICTION * math.sqrt(mesh)) - 1.0)


@dataclass(frozen=True)
class Slide:
    """A motion of an indenter with friction over a gel, in [mm]."""

    length: float  # along the surface
    before: float  # of all slides before, since it came to the gel
    away: float  # how far along the surface it ends from where it came to the gel
    depth: float  # of the indenter's lowest point below the untouched surface
    shear_mach: float  # its peak speed over that of the gel's shear wave
    friction: float
    edge_radius: float  # of the indenter's edges; infinite where none reaches the gel

    def unfollowed(self, element: float, thickness: float) -> str:
        """Why it does not end as a slow one, and what to do; empty where it does. `element`: edge of an element of the
        gel, and how thick that is."""
        if self.shear_mach > MAX_SLIDE_SHEAR_MACH:
            return "contact slips by inertia at that speed; leave out settling.mach, or lower it"
        if self.depth <= 0.0:  # it is lifted off
            return ""
        catching, slid = MIN_EDGE_RADIUS * element, (self.before + self.length) / (1 + ROUNDING)
        if self.edge_radius < catching * (1 - 1e-9) and slid > MAX_CAUGHT_SLIDE * element:
            return (
                f"an edge sharper than {catching:g} mm catches on the mesh as it is slid; for a drag to rely on, give "
                f"it so large an edge_radius (--edge-radius; an STL file: draw it round), or a smaller element_size"
            )
        walls, steep = math.isfinite(self.edge_radius), self.friction > STEEP_FRICTION
        deep = (DEEP_WITH_EDGES if walls or steep else DEEP_WITHOUT_EDGES) * thickness
        farthest = (MAX_DEEP_SLIDE_LENGTH if steep and self.depth > deep else MAX_SLIDE_LENGTH) * thickness
        far = max(self.length, self.away) / (1 + ROUNDING)
        if far > farthest and (steep or self.depth > deep):
            what = f"of {self.friction:g} under what is deeper than {deep:.3g} mm"
            if steep:
                what = f"above {STEEP_FRICTION:g}"
            return (
                f"slid by more than {farthest:.3g} mm, a gel {thickness:g} mm thick lets go in snaps at a friction "
                f"{what}, which depend on the speed; for a drag to rely on, slide less far from where it came to the "
                f"gel"
            )
        return ""
