"""Guards of actions, the same for simulated and real arms, as pure functions.

A target that is no pose (a wrong shape, a number that is not finite) is refused. One that lies too far is shortened
along the straight path to it, and the caller reports what was really sent.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from tacsim.interface import Action, FloatArray, GripperTarget, Mask, Pose

MAX_POSITION = 1e3  # from the origin: no sensor is sent beyond [m]
ROUNDING = 1e-9  # of positions: this far outside still counts as inside [m]


class ActionError(ValueError):
    """An action that a rig cannot take: unknown arm, wrong shape or type, a number not finite or out of range."""


class LimitExceeded(RuntimeError):
    """A limit of an arm (force, torque, depth, shear) was exceeded. A real or mock arm follows nothing until
    `recover`, a simulated one as long as it is exceeded."""


def check_action(action: object, movable: Collection[str], rig: str, grippers: Collection[str] = ()) -> Action:
    """`action`, if rig `rig` can take it: an Action that addresses only `movable` arms, each with a Pose or None, and
    only its `grippers`, each with a GripperTarget or None.

    Raises ActionError.
    """
    if not isinstance(action, Action):
        raise ActionError(f"rig '{rig}' takes a tacsim.Action, got {type(action).__name__}")
    if not isinstance(action.tool, Mapping):
        raise ActionError(
            "Action.tool must map arm names to poses of the sensor (not the TCP), such as {'upper': pose}, "
            f"got {type(action.tool).__name__}"
        )
    for name, target in action.tool.items():
        if name not in movable:
            names = ", ".join(sorted(movable)) or "(none)"
            raise ActionError(f"action for '{name}', but rig '{rig}' moves only: {names}")
        if target is not None and not isinstance(target, Pose):
            raise ActionError(f"action for '{name}' must be a tacsim.Pose or None (holds), got {target!r}")
        if target is not None and np.abs(target.position).max() > MAX_POSITION:
            raise ActionError(
                f"target of arm '{name}' is at {target.position.tolist()} m, more than {MAX_POSITION:g} m from the "
                "origin; poses are in metres, in the world frame"
            )
    _check_grippers(action, grippers, rig)
    return action


def _check_grippers(action: Action, grippers: Collection[str], rig: str) -> None:
    if not isinstance(action.grippers, Mapping):
        raise ActionError(
            "Action.grippers must map names of grippers to targets, such as {'hand': GripperTarget(0.0, 5.0)}, "
            f"got {type(action.grippers).__name__}"
        )
    for name, target in action.grippers.items():
        if name not in grippers:
            names = ", ".join(sorted(grippers)) or "(none)"
            raise ActionError(f"action for gripper '{name}', but rig '{rig}' has only the grippers: {names}")
        if target is not None and not is_gripper_target(target):
            raise ActionError(
                f"action for gripper '{name}' must be a tacsim.GripperTarget with a width [m] and a force [N], finite "
                f"and not negative, or None (holds), got {target!r}"
            )


def is_gripper_target(target: object) -> bool:
    """Whether `target` is a GripperTarget with two finite numbers, neither negative."""
    if not isinstance(target, GripperTarget):
        return False
    try:
        return all(math.isfinite(value) and value >= 0.0 for value in (target.width, target.force))
    except TypeError:
        return False


def limit_gripper_target(
    target: GripperTarget, width_range: tuple[float, float], force_range: tuple[float, float]
) -> GripperTarget:
    """`target`, its width [m] and force [N] brought into these ranges: what is sent to a gripper, and reported."""
    width, force = (
        min(max(value, low), high) for value, (low, high) in ((target.width, width_range), (target.force, force_range))
    )
    return target if (width, force) == (target.width, target.force) else GripperTarget(width, force)


def limit_step(target: Pose, current: Pose, max_step: float, max_turn: float) -> Pose:
    """`target` itself if it is within `max_step` [m] and `max_turn` [rad] of `current`; otherwise the farthest such
    pose on the straight path to it, translation and rotation in proportion."""
    from tacsim import pose as se3  # SciPy takes half a second to load; the process that drives an arm needs none of it

    metres, radians = se3.pose_distance(current, target)
    excess = max(metres / max_step, radians / max_turn)
    if excess <= 1.0 + 1e-9:  # rounding
        return target
    return se3.interpolate_pose(current, target, 1.0 / excess)


def finite_targets(targets: ArrayLike) -> Mask:
    """(...,) which of `targets` (..., 7), position [m] and quaternion x y z w, are poses: finite, the position within
    MAX_POSITION, the quaternion of unit length within 1e-3. All False for any other shape."""
    try:
        given = np.asarray(targets, dtype=np.float64)
    except (TypeError, ValueError):
        return np.zeros((), np.bool_)
    if given.ndim == 0 or given.shape[-1] != 7:
        return np.zeros(given.shape[:-1], np.bool_)
    with np.errstate(over="ignore", invalid="ignore"):
        near = (np.abs(given[..., :3]) <= MAX_POSITION).all(-1)
        unit = np.abs(np.sqrt((given[..., 3:] ** 2).sum(-1)) - 1.0) <= 1e-3
    valid: Mask = near & unit & np.isfinite(given).all(-1)
    return valid


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Where the origin of a sensor may be: the half-spaces ``normals @ x <= offsets``, so it is convex."""

    normals: FloatArray  # (n, 3) unit, pointing out of the region
    offsets: FloatArray  # (n,) [m]
    names: tuple[str, ...]  # of the faces, for messages

    def excess(self, points: ArrayLike) -> FloatArray:
        """(...,) how far each of `points` (..., 3) lies outside the region [m]; negative inside."""
        beyond: FloatArray = (np.asarray(points, dtype=np.float64) @ self.normals.T - self.offsets).max(-1)
        return beyond

    def violated_face(self, point: ArrayLike) -> str:
        """The face that `point` (3,) lies farthest beyond, in words; empty inside."""
        beyond = self.normals @ np.asarray(point, dtype=np.float64) - self.offsets
        worst = int(beyond.argmax())
        return "" if beyond[worst] <= ROUNDING else f"{1e3 * beyond[worst]:.3g} mm beyond {self.names[worst]}"


def box_region(lower: ArrayLike, upper: ArrayLike, planes: Iterable[tuple[ArrayLike, ArrayLike]] = ()) -> Region:
    """The box from `lower` (3,) to `upper` (3,) [m], cut by `planes`: (point (3,) [m], normal (3,) into the region).

    Raises ValueError for a box or a cut without an inside, and for a normal that is zero.
    """
    lower_corner, most = np.array(lower, dtype=np.float64), np.array(upper, dtype=np.float64)
    if lower_corner.shape != (3,) or most.shape != (3,) or not (lower_corner < most).all():
        raise ValueError(f"region: must run from a lower to an upper corner [m], got {lower!r} to {upper!r}")
    normals, offsets = [*-np.eye(3), *np.eye(3)], [*-lower_corner, *most]
    names = [f"the workspace's lower {axis} = {value:g} m" for axis, value in zip("xyz", lower_corner, strict=True)]
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


def fraction_inside(starts: ArrayLike, ends: ArrayLike, inside: Region) -> FloatArray:
    """(...,) how much of each straight path from `starts` to `ends`, (..., 3) [m], lies in the region, as a fraction
    from the start. A path from outside counts in full if it ends inside, and not at all otherwise."""
    here = np.asarray(starts, dtype=np.float64) @ inside.normals.T - inside.offsets
    there = np.asarray(ends, dtype=np.float64) @ inside.normals.T - inside.offsets
    fractions: FloatArray = np.maximum(-here, 0.0) / (there - here).clip(min=ROUNDING)
    lower_corner: FloatArray = np.where(there > ROUNDING, fractions, 1.0).min(-1)
    return lower_corner


def fraction_clear(start: ArrayLike, end: ArrayLike, centre: ArrayLike, distance: float) -> float:
    """How much of the straight path from `start` to `end` (3,) [m] keeps `distance` [m] from `centre` (3,), as a
    fraction from the start. A path from inside the sphere counts in full if it leads away from the centre."""
    first, path = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64) - np.asarray(start)
    from_centre = first - np.asarray(centre, dtype=np.float64)
    length2, along, gap = float(path @ path), float(path @ from_centre), float(from_centre @ from_centre) - distance**2
    if along >= 0.0 or length2 == 0.0:
        return 1.0  # away from the centre, or no motion
    if gap <= 0.0:
        return 0.0
    root = along * along - length2 * gap
    return 1.0 if root <= 0.0 else min(1.0, gap / (-along + float(np.sqrt(root))))


def clip_to_region(
    target: Pose, current: Pose, inside: Region | None, spheres: Iterable[tuple[ArrayLike, float]] = ()
) -> tuple[Pose, float]:
    """`target` itself if the straight path from `current` stays `inside` (None: anywhere) and outside the `spheres`
    (centre (3,), radius [m]); otherwise the farthest pose on it up to which it does. Also that fraction of the path."""
    fraction = 1.0 if inside is None else float(fraction_inside(current.position, target.position, inside))
    for centre, radius in spheres:
        fraction = min(fraction, fraction_clear(current.position, target.position, centre, radius))
    if fraction >= 1.0:
        return target, 1.0
    from tacsim import pose as se3

    return se3.interpolate_pose(current, target, fraction), fraction


def stopping_position(position: ArrayLike, velocity: ArrayLike, deceleration: float) -> FloatArray:
    """(3,) where something at `position` [m] comes to rest [m] if it brakes straight from `velocity` (3,) [m/s] with
    `deceleration` [m/s^2]: v^2 / 2a further."""
    moving = np.asarray(velocity, dtype=np.float64)
    speed = float(np.sqrt(moving @ moving))
    rest: FloatArray = np.asarray(position, dtype=np.float64) + moving * (speed / (2.0 * deceleration))
    return rest


def exceeds_wrench(wrench: ArrayLike, force: float, torque: float) -> bool:
    """True if `wrench` (6,) exceeds `force` [N] or `torque` [N m], or is not a number: what cannot be measured cannot
    be guarded."""
    load = np.asarray(wrench, dtype=np.float64).tolist()
    return not (math.hypot(*load[:3]) <= force and math.hypot(*load[3:]) <= torque)


def exceeds_limit(value: float, limit: float | None) -> bool:
    """True if `value` exceeds `limit`, or is not a number. Without a limit (None): False."""
    return limit is not None and not value <= limit


def joint_speed_ratio(before: ArrayLike, after: ArrayLike, speed: float, period: float) -> float:
    """How much faster than `speed` [rad/s] the fastest joint goes from `before` to `after` (n,) [rad] within `period`
    [s]: 1 is at the limit; infinite for a number that is not finite."""
    step = np.abs(np.asarray(after, dtype=np.float64) - np.asarray(before, dtype=np.float64))
    ratio = float(step.max()) / (speed * period)
    return ratio if np.isfinite(ratio) else math.inf


def segment_distance(a0: ArrayLike, a1: ArrayLike, b0: ArrayLike, b1: ArrayLike) -> float:
    """The least distance [m] between the segments from `a0` to `a1` and from `b0` to `b1` (3,) [m].

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
