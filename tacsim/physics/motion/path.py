"""Where driven frames go, and how fast: ramps from rest to rest, and steps that flow into one another.

What falsifies a path-dependent state is the inertia and damping of a motion: they write plastic strain into the body.
What the start writes, the rest of the way mostly undoes; what the stop writes stays. Hence every ramp starts and ends
with zero velocity and zero acceleration, sets off in the time that the gel's wave needs, and slows down over all the
rest (docs/decisions/0002-quasi-static-controller.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.physics.failure.health import LaunchSpan

MM = 1e3
PEAK = 1.875  # peak slope of the ramp over its mean
RAMP = 2.0  # shortest motion, in times of the pressure wave through the gel
SHORT = 0.5  # ways shorter than so many gel thicknesses go slower than they may, if what is pressed yields
FLOW = 1.25  # shortest step that flows, in wave times; longer by as much as its speed changes
LOOK = 1.0  # time of the hold between two looks at the forces, in the same times
ROUNDING = 1e-6  # of a number of substeps
MOST = 1_000_000  # substeps of one motion: hours, and no motion that anybody means


def ramp(t: NDArray[np.float64], rise: float = 0.5) -> NDArray[np.float64]:
    """0 -> 1 with zero first and second derivative at both ends; the velocity rises until t = `rise`, then falls.

    Each side is half of the quintic of minimum jerk (Flash & Hogan 1985), stretched in time; rise = 0.5 is that itself.
    """

    def way(x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integral of the velocity x^2 (2 - x)^2."""
        return x**3 * (4.0 / 3.0 - x + x * x / 5.0)

    up, down = np.minimum(t / rise, 1.0), np.minimum((1.0 - t) / (1.0 - rise), 1.0)
    return np.where(t < rise, PEAK * rise * way(up), 1.0 - PEAK * (1.0 - rise) * way(down))


@dataclass(frozen=True)
class Path:
    """Driven frames on their way from `start` to `end` in `substeps` nominal substeps of `dt` [mm, wave speed 1].

    Each nominal substep is cut into `refine` real ones; all counts of substeps are nominal. look: substeps of the hold
    at its end between two looks at the forces. rise: share of the time in which the velocity rises, of `ramp`.

    rates: velocities at start and end, each (frames, 6), linear and angular, world axes [-, rad/mm]: instead of a ramp
    from rest to rest the path is then the cubic that has them.
    """

    start: Sequence[Pose]
    end: Sequence[Pose]
    substeps: int
    dt: float
    refine: int = 1
    look: int = 20
    rise: float = 0.5
    rates: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @property
    def step(self) -> float:
        """A real substep [mm, wave speed 1]."""
        return self.dt / self.refine

    def drive(self, first: int, last: int) -> NDArray[np.float32]:
        """(n, frames, 6, 3) f32 for substeps first..last, n = (last - first) refine.

        Rows: the rotation matrix, position [mm], velocity, angular velocity; all in world.
        """
        knots = np.arange(first * self.refine, last * self.refine + 1) / (max(self.substeps, 1) * self.refine)
        out = np.empty((len(knots) - 1, len(self.start), 6, 3))
        for index, a in enumerate(self.start):
            way = self._way(index, knots)
            turned, spin = Rotation.from_quat(a.quaternion), np.zeros(3)
            if way[:, 3:].any():
                turned = Rotation.from_rotvec(way[:, 3:]) * turned
                turned, spin = turned[1:], (turned[1:] * turned[:-1].inv()).as_rotvec() / self.step
            out[:, index, :3] = turned.as_matrix()
            out[:, index, 3] = a.position * MM + way[1:, :3]
            out[:, index, 4] = np.diff(way[:, :3], axis=0) / self.step
            out[:, index, 5] = spin
        return np.ascontiguousarray(out, np.float32)

    def _way(self, index: int, knots: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 6) way of a frame from its start [mm], rotation vector [rad], at shares `knots` (n,) of the time."""
        t = np.clip(knots, 0.0, 1.0)[:, None]
        whole = displacement_between(self.start[index], self.end[index])
        if self.rates is None:
            ramped: NDArray[np.float64] = ramp(t, self.rise) * whole
            return ramped
        before, after = (self.substeps * self.dt * rates[index] for rates in self.rates)
        cubic: NDArray[np.float64] = t * t * (3 - 2 * t) * whole + t * (1 - t) * ((1 - t) * before - t * after)
        return cubic

    def span(self, names: Iterable[str], first: int, last: int) -> LaunchSpan:
        """Where the frames called `names` are on substeps first..last."""
        part = (
            f"substeps {first} to {last} of {self.substeps} of the motion"
            if self.substeps
            else "the hold after the motion"
        )
        at, poses = np.array([last / max(self.substeps, 1)]), {}
        for index, (name, a) in enumerate(zip(names, self.start, strict=True)):
            way, quaternion = self._way(index, at)[0], a.quaternion
            if way[3:].any():
                quaternion = (Rotation.from_rotvec(way[3:]) * Rotation.from_quat(quaternion)).as_quat()
            poses[name] = Pose(a.position + way[:3] / MM, quaternion)
        return LaunchSpan(f"in {part}", poses)


def displacement_between(a: Pose, b: Pose) -> NDArray[np.float64]:
    """(6,) from a to b: position [mm], rotation vector [rad], world axes."""
    way = np.zeros(6)
    way[:3] = (b.position - a.position) * MM
    if not np.array_equal(a.quaternion, b.quaternion):  # most motions turn nothing, and that is seen at once
        way[3:] = (Rotation.from_quat(b.quaternion) * Rotation.from_quat(a.quaternion).inv()).as_rotvec()
    return way


def longest(ways: NDArray[np.float64], lever: float) -> float:
    """Of ways or rates (frames, 6), linear and angular, that of the fastest point; `lever` [mm]: to the gel's rim."""
    linear, angular = (np.linalg.norm(part, axis=1) for part in np.split(ways, 2, axis=1))
    return float((linear + lever * angular).max())


def path_length(start: Sequence[Pose], end: Sequence[Pose], lever: float) -> float:
    """The way of the fastest point [mm]; `lever` [mm] turns rotation into a way at the gel's rim."""
    return longest(np.array([displacement_between(a, b) for a, b in zip(start, end, strict=True)]), lever)


def plan(
    start: Sequence[Pose], end: Sequence[Pose], mach: float, dt: float, lever: float, thickness: float, *,
    yields: bool = False,
) -> Path:  # fmt: skip
    """A path whose fastest point moves at peak Mach `mach`; it lasts no less than RAMP gel thicknesses [mm], since a
    shorter jolt mostly makes the gel ring, and reaches its full speed within half of that.

    What the stop writes into a body that `yields` grows with how hard it brakes, so short ways go slower: with the root
    of their length, which is the same braking for all.

    Raises ValueError for a way that takes more than MOST substeps.
    """
    look = math.ceil(LOOK * thickness / dt)
    length = path_length(start, end, lever)
    if length == 0:
        return Path(start, end, 0, dt, look=look)
    if yields:
        mach *= min(1.0, math.sqrt(length / (SHORT * thickness)))
    lasting = max(PEAK * length / mach, RAMP * thickness)
    return Path(start, end, _substeps(lasting / dt, length, mach), dt, look=look, rise=RAMP * thickness / 2 / lasting)


def plan_flow(
    start: Sequence[Pose], end: Sequence[Pose], rates: NDArray[np.float64], mach: float, dt: float, lever: float,
    thickness: float,
) -> Path:  # fmt: skip
    """The path of a step that flows: from `start`, left at `rates` (frames, 6), to `end`, passed at the mean speed of
    the step as if it were the same all the way; at most Mach `mach`. Where speeds change it lasts longer, up to twice
    as long from rest. Without a way and at rest it has no substeps. Raises ValueError as `plan` does."""
    ways = np.array([displacement_between(a, b) for a, b in zip(start, end, strict=True)])
    look = math.ceil(LOOK * thickness / dt)
    if not (ways.any() or rates.any()):
        return Path(start, end, 0, dt, look=look)
    length = longest(ways, lever)
    lasting = dt * _substeps(max(length / mach, FLOW * thickness) / dt - ROUNDING, length, mach)
    onward = ways / lasting
    lasting *= 1.0 + longest(onward - rates, lever) / mach
    substeps = _substeps(lasting / dt - ROUNDING, length, mach)
    return Path(start, end, substeps, dt, look=look, rates=(rates, onward))


def _substeps(count: float, length: float, mach: float) -> int:
    """The whole number for `count`. Raises ValueError for a way of `length` [mm] that takes more than MOST of them."""
    if not count <= MOST:
        raise ValueError(
            f"a way of {length / MM:.3g} m at Mach {mach:.3g} would take {count:.2g} substeps (limit {MOST:,}); are "
            f"the targets in metres? if so, go there in several motions, or faster"
        )
    return math.ceil(count)


def resolve_targets(poses: Mapping[str, Pose], targets: Mapping[str, Pose]) -> dict[str, Pose]:
    """Where every driven frame ends. Raises KeyError for a frame that is not driven, TypeError for what is no pose."""
    if not isinstance(targets, Mapping):
        raise TypeError(f"targets are poses by the names of frames ({', '.join(poses)}), found {targets!r}")
    unknown = [str(name) for name in targets if name not in poses]
    if unknown:
        raise KeyError(f"no driven frame {', '.join(unknown)}; this world drives {', '.join(poses)}")
    for name, target in targets.items():
        if not isinstance(target, Pose):
            raise TypeError(f"target of '{name}' must be a Pose, found {target!r}; leave '{name}' out and it stays")
    return {**poses, **targets}
