"""Where driven frames go, and how fast: ramps from rest to rest, and steps that flow into one another.

What falsifies a path-dependent state is the inertia and damping of a motion: they write plastic strain into the body.
What the start writes, the rest of the path mostly undoes; what the stop writes stays. Hence every ramp starts and ends
with zero velocity and zero acceleration, sets off in the time that the gel's wave needs, and slows down over all the
rest (docs/decisions/0002-quasi-static-controller.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tacsim import pose as se3
from tacsim.interface import Pose
from tacsim.physics.failure.health import LaunchSpan
from tacsim.physics.motion.tuning import (
    FLOW_RISE_TIME,
    MAX_SUBSTEPS,
    MIN_FLOW_TIME,
    MIN_RAMP_TIME,
    PASSING_VELOCITY,
    READING_INTERVAL,
    ROUNDING,
    SHORT_PATH,
)
from tacsim.physics.units import MM

PEAK_SLOPE = 1.875  # of the ramp, over its mean
PEAK_BRAKING = 2.89  # of a ramp that rises quickly: its largest deceleration times the square of its time, over its way


def ramp(t: NDArray[np.float64], rise: float = 0.5) -> NDArray[np.float64]:
    """0 -> 1 with zero first and second derivative at both ends; the velocity rises until t = `rise`, then falls.

    Each side is half of the quintic of minimum jerk (Flash & Hogan 1985), stretched in time; rise = 0.5 is that itself.
    """

    def half(x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integral of the velocity x^2 (2 - x)^2."""
        return x**3 * (4.0 / 3.0 - x + x * x / 5.0)

    up, down = np.minimum(t / rise, 1.0), np.minimum((1.0 - t) / (1.0 - rise), 1.0)
    return np.where(t < rise, PEAK_SLOPE * rise * half(up), 1.0 - PEAK_SLOPE * (1.0 - rise) * half(down))


def lingering(rise: float, slower: float, last: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and shares of the way of a `ramp` whose end takes longer: `slower` times as long over the `last` share of
    the way, from twice that on ever slower. The times go from 0 to how many times as long all of it takes."""
    knot_count = 2001  # of the numbers that a path whose end takes longer is interpolated between
    knots = np.linspace(0.0, 1.0, knot_count)
    shares = ramp(knots, rise)
    near = np.clip(2.0 - (1.0 - shares) / last, 0.0, 1.0)
    longer = 1.0 + (slower - 1.0) * near**2 * (3.0 - 2.0 * near)
    return np.append(0.0, np.cumsum((longer[1:] + longer[:-1]) / 2.0)) / (knot_count - 1), shares


@dataclass(frozen=True)
class Path:
    """Driven frames move from `start` to `end` in `substeps` nominal substeps of `dt` [mm, wave speed 1].

    Each nominal substep is cut into `refine` real ones; all counts of substeps are nominal. interval: substeps of the
    hold at its end between two readings of the forces. rise: share of the time in which the velocity rises, of `ramp`.
    lingers: how many times slower its end is, and over which last share of the way, of a path from rest to rest.

    unfollowed: why it does not end as a slow one, and what to do; empty where it does.
    creeps: what it moves yields, and creeps on when it has ended.
    max_force_loss: how much of its force the hold may take, if it shall end as a slow one: see
    `tacsim.physics.motion.controller.force_loss`.
    growing: how far it presses an indenter in while it slides it: see `tacsim.physics.motion.slide.growth`.
    turning: how much of an indenter's drag lies across the way that it is slid: see `tacsim.physics.motion.slide.turn`.
    dragging: it drags a body along the gels, which may slip.

    rates: velocities at start and end, each (frames, 6), linear and angular, world axes [-, rad/mm], of a path that is
    not from rest to rest. The one turns into the other within `rise`, and a ramp does the rest of the way.
    """

    start: Sequence[Pose]
    end: Sequence[Pose]
    substeps: int
    dt: float
    refine: int = 1
    interval: int = 20
    rise: float = 0.5
    lingers: tuple[float, float] | None = None
    unfollowed: str = ""
    creeps: bool = False
    max_force_loss: float = math.inf
    growing: float = 0.0
    turning: float = 0.0
    dragging: bool = False
    rates: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @property
    def step(self) -> float:
        """A real substep [mm, wave speed 1]."""
        return self.dt / self.refine

    def peak_mach(self, lever: float) -> float:
        """Of its fastest point, of a path from rest to rest, at most; lever: see `of_fastest_point`."""
        longer = 1.0 if self.lingers is None else float(lingering(self.rise, *self.lingers)[0][-1])
        return PEAK_SLOPE * longer * path_length(self.start, self.end, lever) / (max(self.substeps, 1) * self.dt)

    def drive(self, first: int, last: int) -> NDArray[np.float32]:
        """(n, frames, 6, 3) f32 for substeps first..last, n = (last - first) refine.

        Rows: the rotation matrix, position [mm], velocity, angular velocity; all in world.
        """
        knots = np.arange(first * self.refine, last * self.refine + 1) / (max(self.substeps, 1) * self.refine)
        out = np.zeros((len(knots) - 1, len(self.start), 6, 3))
        for index, a in enumerate(self.start):
            out[:, index, :3], out[:, index, 3] = _matrix(*a.quaternion.tolist()), a.position * MM
        if not self.substeps:
            return np.ascontiguousarray(out, np.float32)
        moved = self._displacements(knots)
        out[:, :, 3] += moved[1:, :, :3]
        out[:, :, 4] = np.diff(moved[..., :3], axis=0) / self.step
        for index in np.flatnonzero(moved[..., 3:].any(axis=(0, 2))).tolist():
            from scipy.spatial.transform import Rotation  # slow to import, and most motions turn nothing

            turned = Rotation.from_rotvec(moved[:, index, 3:]) * Rotation.from_quat(self.start[index].quaternion)
            out[:, index, :3] = turned[1:].as_matrix()
            out[:, index, 5] = (turned[1:] * turned[:-1].inv()).as_rotvec() / self.step
        return np.ascontiguousarray(out, np.float32)

    def _displacements(self, knots: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, frames, 6) from the start: [mm], rotation vector [rad], at shares `knots` (n,) of the time."""
        t = np.clip(knots, 0.0, 1.0)[:, None, None]
        whole = displacements_between(self.start, self.end)
        if self.rates is None:
            return self._progress(t) * whole
        before, after = (self.substeps * self.dt * rates for rates in self.rates)
        turned = np.minimum(t / self.rise, 1.0)  # the share u of the turn; its velocity falls as 1 - 3 u^2 + 2 u^3
        flown = after * t + (before - after) * self.rise * (turned - turned**3 + turned**4 / 2)
        left = whole - after - (before - after) * self.rise / 2
        moved: NDArray[np.float64] = flown + ramp(t, self.rise) * left
        return moved

    def _progress(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shares of the way at shares `t` of the time, of a path from rest to rest."""
        if self.lingers is None:
            return ramp(t, self.rise)
        times, shares = lingering(self.rise, *self.lingers)
        return np.asarray(np.interp(t * times[-1], times, shares))

    def span(self, names: Iterable[str], first: int, last: int) -> LaunchSpan:
        """Substeps first..last in words, and where the frames called `names` are at their end."""
        if not self.substeps:
            return LaunchSpan("in the hold after the motion", dict(zip(names, self.start, strict=True)))
        words = f"in substeps {first} to {last} of {self.substeps} of the motion"
        at, poses = self._displacements(np.array([last / max(self.substeps, 1)]))[0], {}
        for name, a, moved in zip(names, self.start, at, strict=True):
            quaternion = a.quaternion
            if moved[3:].any():
                from scipy.spatial.transform import Rotation

                quaternion = (Rotation.from_rotvec(moved[3:]) * Rotation.from_quat(quaternion)).as_quat()
            poses[name] = Pose(a.position + moved[:3] / MM, quaternion)
        return LaunchSpan(words, poses)


@lru_cache(maxsize=64)
def _matrix(*quaternion: float) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of a frame that does not turn: most never do."""
    return se3.rotation_matrix(Pose(quaternion=np.array(quaternion)))


def displacement_between(a: Pose, b: Pose) -> NDArray[np.float64]:
    """(6,) from a to b: [mm], rotation vector [rad], world axes."""
    displacement = np.zeros(6)
    displacement[:3] = (b.position - a.position) * MM
    if not np.array_equal(a.quaternion, b.quaternion):  # most motions turn nothing, and that is seen at once
        from scipy.spatial.transform import Rotation

        displacement[3:] = (Rotation.from_quat(b.quaternion) * Rotation.from_quat(a.quaternion).inv()).as_rotvec()
    return displacement


def displacements_between(start: Sequence[Pose], end: Sequence[Pose]) -> NDArray[np.float64]:
    """(frames, 6): `displacement_between` of each."""
    return np.array([displacement_between(a, b) for a, b in zip(start, end, strict=True)])


def of_fastest_point(vectors: NDArray[np.float64], lever: float) -> float:
    """Displacements or rates (frames, 6), linear and angular, to that of the fastest point; `lever` [mm]: from a
    frame's origin to the gel's rim."""
    linear, angular = (np.linalg.norm(part, axis=1) for part in np.split(vectors, 2, axis=1))
    return float((linear + lever * angular).max())


def path_length(start: Sequence[Pose], end: Sequence[Pose], lever: float) -> float:
    """Of the fastest point [mm]; lever: see `of_fastest_point`."""
    return of_fastest_point(displacements_between(start, end), lever)


def path_along(start: Sequence[Pose], end: Sequence[Pose], lever: float) -> float:
    """What of it goes along the surface of the first frame, a sensor, turns included [mm]."""
    displacements = displacements_between(start, end)
    normal = se3.rotation_matrix(start[0])[:, 2]
    displacements[:, :3] -= np.outer(displacements[:, :3] @ normal, normal)
    return of_fastest_point(displacements, lever)


def plan(
    start: Sequence[Pose], end: Sequence[Pose], mach: float, dt: float, lever: float, thickness: float, *,
    remembered: float = 0.0, short: float = SHORT_PATH, slower: float = 1.0, last: float = 0.0, shortest: float = 0.0,
) -> Path:  # fmt: skip
    """A path whose fastest point moves at peak Mach `mach`; it lasts no less than MIN_RAMP_TIME gel thicknesses [mm],
    since a shorter jolt mostly makes the gel ring, and reaches its full speed within half of that.

    remembered: length of the path [mm] whose stop leaves a trace: all of it in a body that yields; in friction what
    of it goes along the surface, where the stop finds the gel. The trace grows with how hard the path brakes, so
    those shorter than `short` gel thicknesses go slower: with the root of their length, the same braking for all.
    slower: than that, how many times, the `last` [mm] of it is; see `lingering`.
    shortest: time [mm, wave speed 1] that it lasts at least.

    Raises ValueError for a path that takes more than MAX_SUBSTEPS.
    """
    interval = math.ceil(READING_INTERVAL * thickness / dt)
    length = path_length(start, end, lever)
    if length == 0:
        return Path(start, end, 0, dt, interval=interval)
    braked = math.sqrt(remembered * max(remembered, short * thickness))
    lasting = max(PEAK_SLOPE * max(length, braked) / mach, MIN_RAMP_TIME * thickness, shortest)
    rise, lingers = MIN_RAMP_TIME * thickness / 2 / lasting, None
    if slower > 1.0:
        lingers = slower, last / length
        lasting *= float(lingering(rise, *lingers)[0][-1])
    substeps = _substeps(lasting / dt, length, mach)
    return Path(start, end, substeps, dt, interval=interval, rise=rise, lingers=lingers)


def plan_flow(
    start: Sequence[Pose], end: Sequence[Pose], rates: NDArray[np.float64], mach: float, dt: float, lever: float,
    thickness: float,
) -> Path:  # fmt: skip
    """The path of a step that flows: from `start`, left at `rates` (frames, 6), to `end`, passed at PASSING_VELOCITY
    times its mean. That is Mach `mach`; slower with the root of the length where it is less than SHORT_PATH gel
    thicknesses [mm], as in `plan`. With no displacement and at rest it has no substeps. Raises as `plan` does."""
    displacements = displacements_between(start, end)
    interval = math.ceil(READING_INTERVAL * thickness / dt)
    if not (displacements.any() or rates.any()):
        return Path(start, end, 0, dt, interval=interval)
    length = of_fastest_point(displacements, lever)
    braked = math.sqrt(length * max(length, SHORT_PATH * thickness))
    substeps = _substeps(max(braked / mach, MIN_FLOW_TIME * thickness) / dt - ROUNDING, length, mach)
    lasting = substeps * dt
    rise = min(FLOW_RISE_TIME * thickness / lasting, 0.5)
    return Path(
        start, end, substeps, dt, interval=interval, rise=rise,
        rates=(rates, PASSING_VELOCITY * displacements / lasting),
    )  # fmt: skip


def _substeps(count: float, length: float, mach: float) -> int:
    """`count` rounded up. Raises ValueError for a path of `length` [mm] that takes more than MAX_SUBSTEPS."""
    if not count <= MAX_SUBSTEPS:
        raise ValueError(
            f"a path of {length / MM:.3g} m at Mach {mach:.3g} would take {count:.2g} substeps (limit "
            f"{MAX_SUBSTEPS:,}); are the targets in metres? if so, go there in several motions, or faster"
        )
    return math.ceil(count)


def resolve_targets(poses: Mapping[str, Pose], targets: Mapping[str, Pose]) -> dict[str, Pose]:
    """Where every driven frame ends. Raises KeyError for a frame that is not driven."""
    unknown = [str(name) for name in targets if name not in poses]
    if unknown:
        raise KeyError(f"no driven frame {', '.join(unknown)}; this world drives {', '.join(poses)}")
    return {**poses, **targets}
