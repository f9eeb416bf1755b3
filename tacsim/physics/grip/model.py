"""Rigid objects between gel pads, what else holds them, and the states in which they come to rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.models.scene import Mesh, Shape
from tacsim.physics.grip.tuning import MAX_MASS

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

    def rows(self, count: int) -> tuple[Floats, Floats]:
        """(n, 6) stiffness and (n, 2) limits. Raises ValueError for numbers that are negative or not finite."""
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
        return stiffness, limits


@dataclass(frozen=True, slots=True, eq=False)
class GripCommand:
    """One control step of one grip, see `GripWorld.step`."""

    pads: Floats  # (k, 7) poses at the end, world [m]
    force: float | None = None  # grip force [N]; None: the pads stay at their poses
    support: Support | None = None


def support_rows(support: Support | None, count: int) -> tuple[Floats, Floats]:
    """(n, 6) stiffness and (n, 2) limits, zeros without a support. Raises ValueError as `Support.rows`."""
    return (np.zeros((count, 6)), np.zeros((count, 2))) if support is None else support.rows(count)


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
