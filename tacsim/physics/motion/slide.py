"""Slides of an indenter with friction over a gel: reductions of their speed, and limits of the quasi-static motion.

A contact that slips keeps the shear at the end of a motion. Reasons for each rule: docs/physics-motion.md.
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
    MAX_BLOCKED_SLIDE,
    MAX_DEEP_SLIDE_LENGTH,
    MAX_SLIDE_LENGTH,
    MAX_SLIDE_SHEAR_MACH,
    MAX_SNAP_FRICTION,
    ROUNDING,
    STEEP_FRICTION,
    TURNING_SPEED_RANGE,
    WALL_SNAP_FRICTION,
)


def growth_share(displacement: NDArray[np.float64]) -> float:
    """Indentation during a slide with `displacement` (3,), sensor axes, as a share from 0 to 1: 1 where the depth grows
    by a quarter of the slide's length or more."""
    slid = math.hypot(displacement[0], displacement[1])
    return min(1.0, float(-4.0 * displacement[2] / slid)) if displacement[2] < 0.0 < slid else 0.0


def turn_share(displacement: NDArray[np.float64], force: NDArray[np.float64], friction: float) -> float:
    """Drag across the `displacement` (3,) of an indenter over the friction limit, from 0 to 1; `force` (3,) on the
    sensor [N]; both in sensor axes."""
    slid, limit = math.hypot(displacement[0], displacement[1]), friction * abs(force[2])
    if slid <= ROUNDING * abs(displacement[2]) or limit == 0.0:
        return 0.0
    return float(min(1.0, abs(force[0] * displacement[1] - force[1] * displacement[0]) / (limit * slid)))


def release_share(displacement: NDArray[np.float64], force: NDArray[np.float64], friction: float) -> float:
    """Drag over the friction limit, times the lifting share of the indenter's `displacement` (3,), from 0 to 1; `force`
    (3,) on the sensor [N]; both in sensor axes."""
    limit = friction * abs(force[2])
    if displacement[2] <= 0.0 or limit == 0.0:
        return 0.0
    return float(min(1.0, math.hypot(force[0], force[1]) / limit) * displacement[2] / np.linalg.norm(displacement))


def speed_share(displacement: NDArray[np.float64], force: NDArray[np.float64], friction: float) -> float:
    """Speed over the default speed for a `displacement` (3,) of an indenter, with which it ends in the state of a slow
    motion; `force` (3,) on the sensor [N]; both in sensor axes."""
    slowest, fastest = TURNING_SPEED_RANGE
    share = 1.0 - turn_share(displacement, force, friction) * (1.0 - min(max(friction, slowest), fastest))
    return share * (1.0 - release_share(displacement, force, friction) * (1.0 - LIFTING_SPEED))


def wall_slowdown(displacement: NDArray[np.float64], friction: float, mesh: float) -> float:
    """Factor by which the end of the `displacement` (3,) of an indenter is slower, if its edges reach the gel, so that
    it ends in the state of a slow motion. mesh: element size over the gel's thickness."""
    length = float(np.linalg.norm(displacement))
    along = math.hypot(displacement[0], displacement[1]) / length if length > 0.0 else 0.0
    return 1.0 + along * max(0.0, min(friction, MAX_SNAP_FRICTION) / (WALL_SNAP_FRICTION * math.sqrt(mesh)) - 1.0)


@dataclass(frozen=True)
class Slide:
    """A motion of an indenter with friction over a gel, in [mm]."""

    length: float  # along the surface
    earlier_length: float  # of all slides since the first contact, before this one
    end_distance: float  # along the surface, from the point of first contact to the end
    depth: float  # of the indenter's lowest point below the untouched surface
    shear_mach: float  # its peak speed over that of the gel's shear wave
    friction: float
    edge_radius: float  # of the indenter's edges; infinite where none reaches the gel

    def unsettled_reason(self, element: float, thickness: float) -> str:
        """Why it does not end in the state of a slow motion, and advice; empty where it does. `element`: edge length of
        the gel's elements, `thickness`: of the gel [mm]."""
        if self.shear_mach > MAX_SLIDE_SHEAR_MACH:
            return "contact slips by inertia at that speed; leave out settling.mach, or lower it"
        if self.depth <= 0.0:  # no contact at the end
            return ""
        catching, slid = MIN_EDGE_RADIUS * element, (self.earlier_length + self.length) / (1 + ROUNDING)
        if self.edge_radius < catching * (1 - 1e-9) and slid > MAX_BLOCKED_SLIDE * element:
            return (
                f"an edge sharper than {catching:g} mm catches on the mesh in a slide; for a correct drag, give it an "
                f"edge_radius of this size (--edge-radius; in a mesh file: draw it round), or a smaller element_size"
            )
        walls, steep = math.isfinite(self.edge_radius), self.friction > STEEP_FRICTION
        deep = (DEEP_WITH_EDGES if walls or steep else DEEP_WITHOUT_EDGES) * thickness
        farthest = (MAX_DEEP_SLIDE_LENGTH if steep and self.depth > deep else MAX_SLIDE_LENGTH) * thickness
        far = max(self.length, self.end_distance) / (1 + ROUNDING)
        if far > farthest and (steep or self.depth > deep):
            what = f"of {self.friction:g} and a depth of more than {deep:.3g} mm"
            if steep:
                what = f"above {STEEP_FRICTION:g}"
            return (
                f"slid by more than {farthest:.3g} mm, a gel {thickness:g} mm thick slips in snaps at a friction "
                f"{what}, and the snaps depend on the speed; for a correct drag, slide less far from the point of "
                f"first contact"
            )
        return ""
