"""Rigid objects between gel pads, what else holds them, and the states in which they come to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.models.scene import Mesh, Shape
from tacsim.physics.grip import layout
from tacsim.physics.grip.tuning import GUIDE_STIFFNESS, MAX_MASS

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class HeldObject:
    """A rigid object between pads. Its inertia has no effect: only states at rest count."""

    geometry: Shape
    mass: float  # [kg]
    friction: float = 0.6  # of object and gels
    edge_radius: float | None = None  # of a box's or cylinder's edges [m]; None: as the mesh carries them
    centre_of_mass: tuple[float, float, float] | None = None  # in its own axes [m]; None: of an even density

    def __post_init__(self) -> None:
        if not (math.isfinite(self.mass) and 0.0 < self.mass <= MAX_MASS):
            raise ValueError(f"mass is {self.mass:g} kg; give one above 0 and at most {MAX_MASS:g} kg")
        if self.centre_of_mass is not None and not np.isfinite(self.centre_of_mass).all():
            raise ValueError(f"centre_of_mass is {self.centre_of_mass}; give three finite lengths [m]")


@dataclass(frozen=True, slots=True, eq=False)
class HeldStates:
    """Where objects and pads are after a step, and what they do to each other; n grips of k pads."""

    objects: Floats  # (n, 7) position of the centre of the bounding box [m], quaternion x, y, z, w, world
    pads: Floats  # (n, k, 7) poses of the pads in world, closed as far as they are
    wrenches: Floats  # (n, k, 6) of the object on each pad at the end, about its origin, in its axes [N, N m]
    closings: Floats  # (n,) of each pad along its z axis from the pose that was asked for [m]; 0 without a grip force
    touching: NDArray[np.bool_]  # (n, k)
    slip_shares: Floats  # (n, k) share of the limit of friction that is used; 1: the object slides, or nothing touches
    dropped: NDArray[np.bool_]  # (n,) no pad touches an object that one has touched
    imbalances: Floats  # (n,) of forces and moments, relative to the largest contact force, in the last substep [-]
    at_rest: NDArray[np.bool_]  # (n,) whether that is within the tolerance
    substeps: NDArray[np.int64]  # (n,) that the step took
    limited_substeps: NDArray[np.int64]  # (n,) of them in which a guard limited the speed of an object that falls

    def row(self, index: int) -> HeldStates:
        """One of the grips."""
        return HeldStates(**{each.name: getattr(self, each.name)[index : index + 1] for each in fields(self)})


@dataclass(frozen=True)
class Support:
    """Springs and friction that hold an object in addition to the pads: a table, a guide, a hand that carries it.

    Each number is of all grips, or one for each.
    """

    stiffness: ArrayLike  # (6,) or (n, 6) along x, y, z [N/m] and about them [N m/rad], world axes
    max_force: ArrayLike = math.inf  # [N] above which it slides along
    max_moment: ArrayLike = math.inf  # [N m]

    def rows(self, count: int) -> Floats:
        """(n, SUPPORT_NUMBERS + 1), as in grip.layout (the last: `GuideSupport.drag`). Raises ValueError for
        numbers that are negative or not finite."""
        try:
            stiffness = np.broadcast_to(np.asarray(self.stiffness, np.float64), (count, 6))
            limits = np.stack(
                [np.broadcast_to(np.asarray(each, np.float64), count) for each in (self.max_force, self.max_moment)],
                axis=1,
            )
        except ValueError:
            raise ValueError(
                f"a support needs a stiffness (6,) or ({count}, 6), and limits of one number or ({count},); got "
                f"{np.shape(self.stiffness)}, {np.shape(self.max_force)} and {np.shape(self.max_moment)}"
            ) from None
        if not (np.isfinite(stiffness).all() and (stiffness >= 0.0).all() and (limits >= 0.0).all()):
            raise ValueError("stiffness of a support must be finite, and none of its numbers negative")
        free = np.broadcast_to([1.0, 1.0, 1.0, -math.inf, math.inf, 0.0], (count, 6))
        return np.hstack([stiffness, limits, free])


@dataclass(frozen=True)
class GuideSupport:
    """A guide along one world axis, as of a drawer: it lets an object slide along that axis, between two stops, against
    dry friction and a damper, and holds it otherwise.

    Each number is of all grips, or one for each.
    """

    axis: ArrayLike  # 0, 1, 2: world x, y, z
    friction: ArrayLike = 0.0  # [N], however the object is loaded
    # Of the damper, over the time that a step stands for: it resists by the share of the pads' displacement that the
    # object made in the step before [N/m]
    drag: ArrayLike = 0.0
    room: ArrayLike = (-math.inf, math.inf)  # (2,) or (n, 2) stops, along the axis from where the object is now [m]

    def rows(self, count: int) -> Floats:
        """As `Support.rows`. Raises ValueError for another axis, negative numbers, or stops in the wrong order."""
        try:
            axis = np.broadcast_to(np.asarray(self.axis), count)
            friction, drag = (
                np.broadcast_to(np.asarray(each, np.float64), count) for each in (self.friction, self.drag)
            )
            room = np.broadcast_to(np.asarray(self.room, np.float64), (count, 2))
        except ValueError:
            raise ValueError(
                f"a guide needs an axis, a friction and a drag of one number or ({count},), and a room (2,) or "
                f"({count}, 2); got {np.shape(self.axis)}, {np.shape(self.friction)}, {np.shape(self.drag)} and "
                f"{np.shape(self.room)}"
            ) from None
        if not (np.isin(axis, (0, 1, 2)).all() and (friction >= 0.0).all() and (drag >= 0.0).all()):
            raise ValueError("the axis of a guide is 0, 1 or 2, and neither its friction nor its drag is negative")
        if not (room[:, 0] <= room[:, 1]).all():
            raise ValueError("the room of a guide ends before it begins: give the lower stop first")
        stiffness = np.broadcast_to(GUIDE_STIFFNESS, (count, 6))
        limits = np.stack([friction, np.full(count, math.inf)], axis=1)
        return np.hstack([stiffness, limits, np.eye(3)[axis.astype(np.int64)], room, drag[:, None]])


@dataclass(frozen=True, slots=True, eq=False)
class GripCommand:
    """One control step of one grip, see `GripWorld.step`."""

    pads: Floats  # (k, 7) poses at the end, world [m]
    force: float | None = None  # grip force [N]; None: the pads stay at their poses
    support: Support | GuideSupport | None = None


def support_rows(support: Support | GuideSupport | None, count: int) -> Floats:
    """As `Support.rows`, zeros without a support."""
    return np.zeros((count, layout.SUPPORT_NUMBERS + 1)) if support is None else support.rows(count)


def centre_of_mass(item: HeldObject) -> Floats:
    """(3,) in the object's axes, from the centre of its bounding box [m]."""
    if item.centre_of_mass is not None:
        return np.array(item.centre_of_mass, np.float64)
    if isinstance(item.geometry, Mesh):
        from tacsim.geometry.shapes import centred_mesh

        return np.array(centred_mesh(item.geometry).center_mass, np.float64)
    return np.zeros(3)


def facing_pads(poses: ArrayLike, widths: ArrayLike) -> Floats:
    """Poses (..., 2, 7) of two pads that face each other along x of a gripper, which is at `poses` (..., 7) in world.

    widths: (...,) between their surfaces [m]. Pad 0 is at -x and looks along x; the y axes of both are the gripper's.
    """
    from scipy.spatial.transform import Rotation

    given = np.asarray(poses, np.float64)
    half = np.broadcast_to(np.asarray(widths, np.float64), given.shape[:-1]) / 2
    turns = Rotation.from_quat(given[..., 3:].reshape(-1, 4))
    found = np.empty((*given.shape[:-1], 2, 7))
    for pad, side in enumerate((-1.0, 1.0)):
        arms = np.multiply.outer(side * half.ravel(), [1.0, 0.0, 0.0])
        found[..., pad, :3] = given[..., :3] + turns.apply(arms).reshape(*given.shape[:-1], 3)
        own = turns * Rotation.from_euler("y", -side * np.pi / 2)
        found[..., pad, 3:] = own.as_quat().reshape(*given.shape[:-1], 4)
    return found
