"""Paths of driven frames over time: ramps from rest to rest, and steps that pass their targets.

Inertia and damping of a motion cause errors in a path-dependent state: they add plastic strain to the body. Strain that
is added at the start is mostly undone by the rest of the path; strain that is added at the stop stays. Therefore each
ramp starts and ends with zero velocity and zero acceleration, accelerates within the time of the gel's wave, and
decelerates over the rest (docs/decisions/0002-quasi-static-controller.md).
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
    BLEND_VELOCITY,
    FLOW_RISE_TIME,
    MAX_SUBSTEPS,
    MIN_FLOW_TIME,
    MIN_RAMP_TIME,
    READING_INTERVAL,
    ROUNDING,
    SHORT_PATH,
)
from tacsim.physics.units import MM

PEAK_SLOPE = 1.875  # of the ramp, over its mean
PEAK_BRAKING = 2.89  # of a ramp with a short rise: largest deceleration times the square of its time, over its length


def ramp(t: NDArray[np.float64], rise: float = 0.5) -> NDArray[np.float64]:
    """0 -> 1 with zero first and second derivative at both ends; the velocity rises until t = `rise`, then falls.

    Each side is half of the quintic of minimum jerk (Flash & Hogan 1985), stretched in time; rise = 0.5 is that
    quintic.
    """

    def half(x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Integral of the velocity x^2 (2 - x)^2."""
        return x**3 * (4.0 / 3.0 - x + x * x / 5.0)

    up, down = np.minimum(t / rise, 1.0), np.minimum((1.0 - t) / (1.0 - rise), 1.0)
    return np.where(t < rise, PEAK_SLOPE * rise * half(up), 1.0 - PEAK_SLOPE * (1.0 - rise) * half(down))


def slow_end_ramp(rise: float, slowdown: float, end_share: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times and path shares of a `ramp` with a slow end: `slowdown` times slower over the last `end_share` of the path,
    with a transition over the same length before it. The last time is the factor for the whole duration."""
    knot_count = 2001  # of the interpolation
    knots = np.linspace(0.0, 1.0, knot_count)
    shares = ramp(knots, rise)
    near = np.clip(2.0 - (1.0 - shares) / end_share, 0.0, 1.0)
    longer = 1.0 + (slowdown - 1.0) * near**2 * (3.0 - 2.0 * near)
    return np.append(0.0, np.cumsum((longer[1:] + longer[:-1]) / 2.0)) / (knot_count - 1), shares


@dataclass(frozen=True)
class Path:
    """Driven frames move from `start` to `end` in `substeps` nominal substeps of `dt` [mm, wave speed 1].

    Each nominal substep is divided into `refine` real ones; all counts of substeps are nominal. interval: substeps
    between two readings of the forces in a hold. rise: share of the time in which the velocity increases, of `ramp`.
    slow_end: for a path from rest to rest, slowdown of its end and the last share of the path with it.

    unsettled_reason: why it does not end in the state of a slow motion, and advice; empty where it does.
    is_creeping: the moved body yields, and creeps after the motion.
    max_force_loss: largest decrease of force in the hold with which the end counts as that of a slow motion: see
    `tacsim.physics.motion.controller.force_loss`.
    growth_share: indentation during a slide of an indenter: see `tacsim.physics.motion.slide.growth_share`.
    turn_share: share of an indenter's drag across its slide: see `tacsim.physics.motion.slide.turn_share`.
    is_drag: it drags a body along the gels, which may slip.

    rates: velocities at start and end, each (frames, 6), linear and angular, world axes [-, rad/mm], of a path that is
    not from rest to rest. The velocity changes from the first to the second within `rise`; a ramp covers the rest.
    """

    start: Sequence[Pose]
    end: Sequence[Pose]
    substeps: int
    dt: float
    refine: int = 1
    interval: int = 20
    rise: float = 0.5
    slow_end: tuple[float, float] | None = None
    unsettled_reason: str = ""
    is_creeping: bool = False
    max_force_loss: float = math.inf
    growth_share: float = 0.0
    turn_share: float = 0.0
    is_drag: bool = False
    rates: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    @property
    def step(self) -> float:
        """A real substep [mm, wave speed 1]."""
        return self.dt / self.refine

    def peak_mach(self, lever: float) -> float:
        """Largest Mach number of the fastest point, for a path from rest to rest; lever: see `fastest_point_motion`."""
        longer = 1.0 if self.slow_end is None else float(slow_end_ramp(self.rise, *self.slow_end)[0][-1])
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
            from scipy.spatial.transform import Rotation  # slow to import, and most motions have no rotation

            turned = Rotation.from_rotvec(moved[:, index, 3:]) * Rotation.from_quat(self.start[index].quaternion)
            out[:, index, :3] = turned[1:].as_matrix()
            out[:, index, 5] = (turned[1:] * turned[:-1].inv()).as_rotvec() / self.step
        return np.ascontiguousarray(out, np.float32)

    def _displacements(self, knots: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, frames, 6) from the start: [mm], rotation vector [rad], at shares `knots` (n,) of the duration."""
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
        """Path shares at shares `t` of the duration, for a path from rest to rest."""
        if self.slow_end is None:
            return ramp(t, self.rise)
        times, shares = slow_end_ramp(self.rise, *self.slow_end)
        return np.asarray(np.interp(t * times[-1], times, shares))

    def span(self, names: Iterable[str], first: int, last: int) -> LaunchSpan:
        """Text for substeps first..last, and the poses of the frames called `names` at their end."""
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
    """Rotation matrix (3, 3); cached, since most frames do not rotate."""
    return se3.rotation_matrix(Pose(quaternion=np.array(quaternion)))


def displacement_between(a: Pose, b: Pose) -> NDArray[np.float64]:
    """(6,) from a to b: [mm], rotation vector [rad], world axes."""
    displacement = np.zeros(6)
    displacement[:3] = (b.position - a.position) * MM
    if not np.array_equal(a.quaternion, b.quaternion):  # most motions have no rotation
        from scipy.spatial.transform import Rotation

        displacement[3:] = (Rotation.from_quat(b.quaternion) * Rotation.from_quat(a.quaternion).inv()).as_rotvec()
    return displacement


def displacements_between(start: Sequence[Pose], end: Sequence[Pose]) -> NDArray[np.float64]:
    """(frames, 6): `displacement_between` of each."""
    return np.array([displacement_between(a, b) for a, b in zip(start, end, strict=True)])


def fastest_point_motion(vectors: NDArray[np.float64], lever: float) -> float:
    """Displacement or speed of the fastest point, from displacements or rates (frames, 6), linear and angular; `lever`
    [mm]: distance from a frame's origin to the gel's rim."""
    linear, angular = (np.linalg.norm(part, axis=1) for part in np.split(vectors, 2, axis=1))
    return float((linear + lever * angular).max())


def path_length(start: Sequence[Pose], end: Sequence[Pose], lever: float) -> float:
    """Displacement of the fastest point [mm]; lever: see `fastest_point_motion`."""
    return fastest_point_motion(displacements_between(start, end), lever)


def tangential_path_length(start: Sequence[Pose], end: Sequence[Pose], lever: float) -> float:
    """The same along the surface of the first frame, a sensor, with rotations [mm]."""
    displacements = displacements_between(start, end)
    normal = se3.rotation_matrix(start[0])[:, 2]
    displacements[:, :3] -= np.outer(displacements[:, :3] @ normal, normal)
    return fastest_point_motion(displacements, lever)


def plan_path(
    start: Sequence[Pose], end: Sequence[Pose], mach: float, dt: float, lever: float, thickness: float, *,
    memory_length: float = 0.0, short_length: float = SHORT_PATH, end_slowdown: float = 1.0, end_length: float = 0.0,
    min_time: float = 0.0,
) -> Path:  # fmt: skip
    """A path whose fastest point has the peak Mach number `mach`. It takes at least MIN_RAMP_TIME gel thicknesses [mm],
    since a shorter motion mostly excites oscillations of the gel, and accelerates within half of that time.

    memory_length: length [mm] whose stop changes the final state: the whole path for a body that yields; with friction
    the part along the surface. The change grows with the deceleration. Therefore paths shorter than `short_length` gel
    thicknesses are slower, with a speed proportional to the root of their length: the same deceleration for all.
    end_slowdown: factor by which the last `end_length` [mm] is slower; see `slow_end_ramp`.
    min_time: smallest duration [mm, wave speed 1].

    Raises ValueError for a path that takes more than MAX_SUBSTEPS.
    """
    interval = math.ceil(READING_INTERVAL * thickness / dt)
    length = path_length(start, end, lever)
    if length == 0:
        return Path(start, end, 0, dt, interval=interval)
    braked = math.sqrt(memory_length * max(memory_length, short_length * thickness))
    duration = max(PEAK_SLOPE * max(length, braked) / mach, MIN_RAMP_TIME * thickness, min_time)
    rise, lingers = MIN_RAMP_TIME * thickness / 2 / duration, None
    if end_slowdown > 1.0:
        lingers = end_slowdown, end_length / length
        duration *= float(slow_end_ramp(rise, *lingers)[0][-1])
    substeps = _substeps(duration / dt, length, mach)
    return Path(start, end, substeps, dt, interval=interval, rise=rise, slow_end=lingers)


def plan_flow(
    start: Sequence[Pose], end: Sequence[Pose], rates: NDArray[np.float64], mach: float, dt: float, lever: float,
    thickness: float,
) -> Path:  # fmt: skip
    """The path of a flowing step from `start`, with velocities `rates` (frames, 6), to `end`, which it passes at
    BLEND_VELOCITY times its mean velocity. The mean has Mach number `mach`, and less for paths shorter than SHORT_PATH
    gel thicknesses [mm], as in `plan_path`. Without displacement and velocity it has no substeps. Raises ValueError
    like `plan_path`."""
    displacements = displacements_between(start, end)
    interval = math.ceil(READING_INTERVAL * thickness / dt)
    if not (displacements.any() or rates.any()):
        return Path(start, end, 0, dt, interval=interval)
    length = fastest_point_motion(displacements, lever)
    braked = math.sqrt(length * max(length, SHORT_PATH * thickness))
    substeps = _substeps(max(braked / mach, MIN_FLOW_TIME * thickness) / dt - ROUNDING, length, mach)
    duration = substeps * dt
    rise = min(FLOW_RISE_TIME * thickness / duration, 0.5)
    return Path(
        start, end, substeps, dt, interval=interval, rise=rise,
        rates=(rates, BLEND_VELOCITY * displacements / duration),
    )  # fmt: skip


def _substeps(count: float, length: float, mach: float) -> int:
    """`count` rounded up. Raises ValueError for a path of `length` [mm] that takes more than MAX_SUBSTEPS."""
    if not count <= MAX_SUBSTEPS:
        raise ValueError(
            f"a path of {length / MM:.3g} m at Mach {mach:.3g} would take {count:.2g} substeps (limit "
            f"{MAX_SUBSTEPS:,}); are the targets in metres? if so, use several motions, or a higher speed"
        )
    return math.ceil(count)


def resolve_targets(poses: Mapping[str, Pose], targets: Mapping[str, Pose]) -> dict[str, Pose]:
    """Target of every driven frame. Raises KeyError for a frame that is not driven."""
    unknown = [str(name) for name in targets if name not in poses]
    if unknown:
        raise KeyError(f"no driven frame {', '.join(unknown)}; this world drives {', '.join(poses)}")
    return {**poses, **targets}
