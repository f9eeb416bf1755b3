"""Guards of actions, the same for simulated and real arms: pure functions that refuse or shorten, never silently.

What is no pose at all (a wrong shape, a number that is not finite) is refused. What is a pose but lies too far is
shortened on the straight way there, and the caller tells what was really sent.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tacsim.interface import Action, FloatArray, Pose

FARTHEST = 1e3  # a pose beyond is no target of anything that carries a sensor [m]
ROUNDING = 1e-9  # of positions: so far outside still is inside [m]


class ActionError(ValueError):
    """An action that a rig cannot take: unknown arm, wrong shape or type, a number not finite or out of range."""


class LimitExceeded(RuntimeError):
    """A limit of an arm (force, torque, depth, shear) was exceeded. A real or mock arm follows nothing until
    `recover`, a simulated one as long as it is exceeded."""


def check_action(action: object, movable: Collection[str], rig: str) -> Action:
    """`action`, if rig `rig` can take it: an Action that addresses only `movable` arms, each with a Pose or None.

    Raises ActionError.
    """
    if not isinstance(action, Action):
        raise ActionError(f"rig '{rig}' takes a tacsim.interface.Action, got {type(action).__name__}")
    if not isinstance(action.tool, Mapping):
        raise ActionError(
            "Action.tool must be a mapping from arm names to poses, such as {'upper': pose}, "
            f"got {type(action.tool).__name__}"
        )
    for name, target in action.tool.items():
        if name not in movable:
            names = ", ".join(sorted(movable)) or "(none)"
            raise ActionError(f"action for '{name}', but rig '{rig}' moves only: {names}")
        if target is not None and not isinstance(target, Pose):
            raise ActionError(f"action for '{name}' must be a tacsim.interface.Pose or None (holds), got {target!r}")
        if target is not None and np.abs(target.position).max() > FARTHEST:
            raise ActionError(
                f"target of arm '{name}' is at {target.position.tolist()} m, more than {FARTHEST:g} m from the origin; "
                "poses are in metres, in the world frame"
            )
    return action


def check_workspace(target: Pose, lower: ArrayLike, upper: ArrayLike, arm: str) -> Pose:
    """`target`, if its origin lies within the box from `lower` (3,) to `upper` (3,) [m], the faces included.

    Raises ActionError that names the axis; ValueError for a box that has no inside.
    """
    least, most = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    if least.shape != (3,) or most.shape != (3,) or not (least < most).all():
        raise ValueError(
            f"workspace of arm '{arm}' must run from a lower to an upper corner [m], got {lower!r} to {upper!r}"
        )
    for axis, value, low, high in zip("xyz", target.position, least, most, strict=True):
        if not low <= value <= high:
            raise ActionError(
                f"target of arm '{arm}' is outside its workspace: {axis} = {value:.6g} m, allowed {low:.6g} to "
                f"{high:.6g} m; ask for a pose inside, or widen the workspace after checking that nothing stands there"
            )
    return target


def limit_step(target: Pose, now: Pose, longest: float, widest: float) -> Pose:
    """`target` itself if it is within `longest` [m] and `widest` [rad] of `now`; otherwise the farthest pose on the
    straight way there (translation and rotation in step) that is. The caller tells what was really sent.

    Raises ValueError for limits that are not positive.
    """
    from tacsim import pose as se3  # SciPy takes half a second to load; the process that drives an arm needs none of it

    if not longest > 0 or not widest > 0:
        raise ValueError(f"shorten: limits must be positive, got {longest} m and {widest} rad")
    metres, radians = se3.distance(now, target)
    excess = max(metres / longest, radians / widest)
    if excess <= 1.0 + 1e-9:  # rounding of a motion at the limit is none
        return target
    return se3.interpolate(now, target, 1.0 / excess)


def finite_targets(targets: ArrayLike) -> NDArray[np.bool_]:
    """Which of `targets` (..., 7), position [m] and quaternion x y z w, are poses: finite, the position within
    FARTHEST, the quaternion of unit length within 1e-3. (...,) bool; what has another shape is all False."""
    try:
        given = np.asarray(targets, dtype=np.float64)
    except (TypeError, ValueError):
        return np.zeros((), np.bool_)
    if given.ndim == 0 or given.shape[-1] != 7:
        return np.zeros(given.shape[:-1], np.bool_)
    with np.errstate(over="ignore", invalid="ignore"):
        near = (np.abs(given[..., :3]) <= FARTHEST).all(-1)
        unit = np.abs(np.sqrt((given[..., 3:] ** 2).sum(-1)) - 1.0) <= 1e-3
    sound: NDArray[np.bool_] = near & unit & np.isfinite(given).all(-1)
    return sound


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Where the origin of a sensor may be: the half-spaces ``normals @ x <= offsets``, so it is convex."""

    normals: FloatArray  # (n, 3) unit, pointing out of the region
    offsets: FloatArray  # (n,) [m]
    names: tuple[str, ...]  # of the faces, for messages

    def excess(self, points: ArrayLike) -> FloatArray:
        """(..., 3) points -> (...,) how far outside the farthest face each lies [m]; negative inside."""
        given = np.asarray(points, dtype=np.float64)
        deepest: FloatArray = (given @ self.normals.T - self.offsets).max(-1)
        return deepest

    def broken(self, point: ArrayLike) -> str:
        """The face that `point` (3,) breaks most, in words; empty inside."""
        beyond = self.normals @ np.asarray(point, dtype=np.float64) - self.offsets
        worst = int(beyond.argmax())
        return "" if beyond[worst] <= ROUNDING else f"{1e3 * beyond[worst]:.3g} mm beyond {self.names[worst]}"


def region(lower: ArrayLike, upper: ArrayLike, planes: Iterable[tuple[ArrayLike, ArrayLike]] = ()) -> Region:
    """The box from `lower` (3,) to `upper` (3,) [m], cut by `planes`: (point (3,) [m], normal (3,) into the region).

    Raises ValueError for a box or a cut without an inside, and for a normal that is zero.
    """
    least, most = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    if least.shape != (3,) or most.shape != (3,) or not (least < most).all():
        raise ValueError(f"region: must run from a lower to an upper corner [m], got {lower!r} to {upper!r}")
    normals, offsets = [*-np.eye(3), *np.eye(3)], [*-least, *most]
    names = [f"the workspace's lower {axis} = {value:g} m" for axis, value in zip("xyz", least, strict=True)]
    names += [f"the workspace's upper {axis} = {value:g} m" for axis, value in zip("xyz", most, strict=True)]
    for number, (point, normal) in enumerate(planes):
        into = np.array(normal, dtype=np.float64)
        length = float(np.linalg.norm(into))
        if into.shape != (3,) or not 1e-9 < length < np.inf:
            raise ValueError(f"region: plane {number} has no normal: {normal!r}")
        outward = -into / length
        normals.append(outward)
        offsets.append(float(outward @ np.array(point, dtype=np.float64)))
        names.append(f"plane {number}")
    return Region(np.array(normals), np.array(offsets), tuple(names))


def fraction_inside(start: ArrayLike, end: ArrayLike, inside: Region) -> float:
    """How much of the straight way from `start` to `end` (3,) [m] lies in the region, as a fraction from the start.

    From outside, a way that ends inside is free (it only gets better), and any other is closed.
    """
    return float(fractions_inside(start, end, inside))


def fractions_inside(starts: ArrayLike, ends: ArrayLike, inside: Region) -> FloatArray:
    """:func:`fraction_inside` of many ways at once: (..., 3) and (..., 3) -> (...,)."""
    here = np.asarray(starts, dtype=np.float64) @ inside.normals.T - inside.offsets
    there = np.asarray(ends, dtype=np.float64) @ inside.normals.T - inside.offsets
    shares: FloatArray = np.maximum(-here, 0.0) / (there - here).clip(min=ROUNDING)
    least: FloatArray = np.where(there > ROUNDING, shares, 1.0).min(-1)
    return least


def fraction_clear(start: ArrayLike, end: ArrayLike, centre: ArrayLike, distance: float) -> float:
    """How much of the straight way from `start` to `end` (3,) [m] stays `distance` [m] from `centre` (3,), as a
    fraction from the start. From inside the sphere, a way that leads away from the centre is free."""
    first, way = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64) - np.asarray(start)
    from_centre = first - np.asarray(centre, dtype=np.float64)
    length2, along, gap = float(way @ way), float(way @ from_centre), float(from_centre @ from_centre) - distance**2
    if along >= 0.0 or length2 == 0.0:
        return 1.0  # away from it, or on a tangent
    if gap <= 0.0:
        return 0.0
    root = along * along - length2 * gap
    return 1.0 if root <= 0.0 else min(1.0, gap / (-along + float(np.sqrt(root))))


def clip_to_region(
    target: Pose, now: Pose, inside: Region | None, apart: Iterable[tuple[ArrayLike, float]] = ()
) -> tuple[Pose, float]:
    """`target` itself if the whole straight way from `now` lies `inside` (None: anywhere) and keeps clear of the
    spheres `apart` (centre (3,), distance [m]); otherwise the farthest pose on it that does. Also the fraction of the
    way that is left."""
    share = 1.0 if inside is None else fraction_inside(now.position, target.position, inside)
    for centre, distance in apart:
        share = min(share, fraction_clear(now.position, target.position, centre, distance))
    if share >= 1.0:
        return target, 1.0
    from tacsim import pose as se3

    return se3.interpolate(now, target, share), share


def stopping_distance(speed: float, deceleration: float) -> float:
    """v^2 / 2a [m], how far something goes on from `speed` [m/s] that brakes with `deceleration` [m/s^2]."""
    return speed * speed / (2.0 * deceleration)


def braking_end(position: ArrayLike, velocity: ArrayLike, deceleration: float) -> FloatArray:
    """(3,) where something at `position` [m] comes to rest that brakes straight from `velocity` (3,) [m/s]. A box that
    holds this point is the box shrunk by the stopping distance, on the side one moves to."""
    moving = np.asarray(velocity, dtype=np.float64)
    speed = float(np.sqrt(moving @ moving))
    rest: FloatArray = np.asarray(position, dtype=np.float64) + moving * (speed / (2.0 * deceleration))
    return rest


def exceeds_wrench(wrench: ArrayLike, force: float, torque: float) -> bool:
    """True if `wrench` (6,) is heavier than `force` [N] or `torque` [N m], or is not a number: then nothing guards."""
    load = np.asarray(wrench, dtype=np.float64).tolist()
    return not (math.hypot(*load[:3]) <= force and math.hypot(*load[3:]) <= torque)


def exceeds(value: float, limit: float | None) -> bool:
    """True if `value` is more than `limit`, or is not a number: then nothing guards. A limit of None is not watched."""
    return limit is not None and not value <= limit


def joint_step_excess(before: ArrayLike, after: ArrayLike, speed: float, period: float) -> float:
    """How much faster than `speed` [rad/s] the fastest joint goes from `before` to `after` (n,) [rad] within `period`
    [s]: 1 is at the limit; infinite when a number is none."""
    step = np.abs(np.asarray(after, dtype=np.float64) - np.asarray(before, dtype=np.float64))
    share = float(step.max()) / (speed * period)
    return share if np.isfinite(share) else float("inf")


def segment_distance(a0: ArrayLike, a1: ArrayLike, b0: ArrayLike, b1: ArrayLike) -> float:
    """The least distance of two straight pieces, from `a0` to `a1` and from `b0` to `b1` (3,) [m].

    Ericson, Real-Time Collision Detection (2005), 5.1.9.
    """
    start, other = np.asarray(a0, dtype=np.float64), np.asarray(b0, dtype=np.float64)
    along, across, between = np.asarray(a1) - start, np.asarray(b1) - other, start - other
    aa, bb, ab = float(along @ along), float(across @ across), float(along @ across)
    ac, bc = float(along @ between), float(across @ between)
    parallel = aa * bb - ab * ab
    s = min(1.0, max(0.0, (ab * bc - ac * bb) / parallel)) if parallel > 1e-12 * aa * bb and parallel > 0.0 else 0.0
    t = (ab * s + bc) / bb if bb > 0.0 else 0.0
    t = min(1.0, max(0.0, t))
    s = min(1.0, max(0.0, (ab * t - ac) / aa)) if aa > 0.0 else 0.0
    return float(np.linalg.norm(between + s * along - t * across))
