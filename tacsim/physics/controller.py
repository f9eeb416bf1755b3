"""The quasi-static controller: ramped motion of driven frames, then a hold until the measured residual is small.

Materials are rate-independent, so only the path counts. What falsifies it is the inertia and damping of a motion: they
write plastic strain into the body. What the start writes, the rest of the way mostly undoes; what the stop writes
stays. Hence every motion starts and ends with zero velocity and zero acceleration, sets off in the time that the gel's
wave needs, and slows down over all the rest (docs/decisions/0002-quasi-static-controller.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tacsim.interface import Pose
from tacsim.physics.health import Place, SimulationDiverged, State
from tacsim.physics.world import MoveStats
from tacsim.scene import Settling

MM = 1e3
PEAK = 1.875  # peak slope of the ramp over its mean
RAMP = 2.0  # shortest motion, in times of the pressure wave through the gel
SHORT = 0.5  # ways shorter than so many gel thicknesses go slower than they may, if what is pressed yields
PIECE = 20  # substeps of one launch on the way
FLOW = 1.25  # shortest step that flows, in the same times; longer by as much as its speed changes
LOOK = 1.0  # time of the hold between two looks at the forces, in the same times
LOOKS = 2  # earlier looks that a look is compared with: one alone may meet the same phase of what rings
ROUNDING = 1e-6  # of a number of substeps
FLOOR = 1e-3  # residuals are relative to the contact force, but to no less than this share of E thickness^2


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
        whole = way_between(self.start[index], self.end[index])
        if self.rates is None:
            ramped: NDArray[np.float64] = ramp(t, self.rise) * whole
            return ramped
        before, after = (self.substeps * self.dt * rates[index] for rates in self.rates)
        cubic: NDArray[np.float64] = t * t * (3 - 2 * t) * whole + t * (1 - t) * ((1 - t) * before - t * after)
        return cubic

    def place(self, names: Iterable[str], first: int, last: int) -> Place:
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
        return Place(f"in {part}", poses)


def way_between(a: Pose, b: Pose) -> NDArray[np.float64]:
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


def longest_way(start: Sequence[Pose], end: Sequence[Pose], lever: float) -> float:
    """The way of the fastest point [mm]; `lever` [mm] turns rotation into a way at the gel's rim."""
    return longest(np.array([way_between(a, b) for a, b in zip(start, end, strict=True)]), lever)


def plan(
    start: Sequence[Pose], end: Sequence[Pose], mach: float, dt: float, lever: float, thickness: float, *,
    yields: bool = False,
) -> Path:  # fmt: skip
    """A path whose fastest point moves at peak Mach `mach`; it lasts no less than RAMP gel thicknesses [mm], since a
    shorter jolt mostly makes the gel ring, and reaches its full speed within half of that.

    What the stop writes into a body that `yields` grows with how hard it brakes, so short ways go slower: with the root
    of their length, which is the same braking for all.
    """
    look = math.ceil(LOOK * thickness / dt)
    length = longest_way(start, end, lever)
    if length == 0:
        return Path(start, end, 0, dt, look=look)
    if yields:
        mach *= min(1.0, math.sqrt(length / (SHORT * thickness)))
    lasting = max(PEAK * length / mach, RAMP * thickness)
    return Path(start, end, math.ceil(lasting / dt), dt, look=look, rise=RAMP * thickness / 2 / lasting)


def plan_on(
    start: Sequence[Pose], end: Sequence[Pose], rates: NDArray[np.float64], mach: float, dt: float, lever: float,
    thickness: float,
) -> Path:  # fmt: skip
    """The path of a step that flows: from `start`, left at `rates` (frames, 6), to `end`, passed at the mean speed of
    the step as if it were the same all the way; at most Mach `mach`. Where speeds change it lasts longer, up to twice
    as long from rest. Without a way and at rest it has no substeps."""
    ways = np.array([way_between(a, b) for a, b in zip(start, end, strict=True)])
    look = math.ceil(LOOK * thickness / dt)
    if not (ways.any() or rates.any()):
        return Path(start, end, 0, dt, look=look)
    lasting = dt * math.ceil(max(longest(ways, lever) / mach, FLOW * thickness) / dt - ROUNDING)
    onward = ways / lasting
    lasting *= 1.0 + longest(onward - rates, lever) / mach
    return Path(start, end, math.ceil(lasting / dt - ROUNDING), dt, look=look, rates=(rates, onward))


def force_floor(modulus: float, thickness: float) -> float:
    """The smallest force [N] that residuals are relative to, of a gel with Young's modulus [MPa] and thickness [mm]."""
    return FLOOR * modulus * thickness**2


@dataclass(frozen=True)
class Reading:
    """Forces at one instant [N]: contact on each gel and reaction at its backing, world axes; and what guards saw.

    moment: about each sensor's origin, in its own axes, over half the gel's width: the force it means at the rim [N].
    load: external force on the body besides contact, world axes; None is none.
    """

    contact: NDArray[np.float64]  # (gels, 3)
    backing: NDArray[np.float64]  # (gels, 3)
    floor: float  # [N] residuals are relative to at least this
    overlap: float  # [mm]
    guard_hits: int
    moment: NDArray[np.float64] | None = None  # (gels, 3)
    load: NDArray[np.float64] | None = None  # (3,) of the body from elsewhere: its weight


def residual(now: Reading, before: Reading, balanced: bool) -> float:
    """Largest force imbalance, or change of force or moment since `before`, relative to the largest force [-].

    `balanced`: the contact forces on all gels must add up to the body's load: zero without weight (a free body).
    """
    scale = max(float(np.abs(now.contact).max()), now.floor)
    parts = [np.abs(now.contact - now.backing).max(), np.abs(now.contact - before.contact).max()]
    if now.moment is not None and before.moment is not None:  # a twist settles later than the forces
        parts.append(np.abs(now.moment - before.moment).max())
    if balanced:
        load = 0.0 if now.load is None else now.load
        parts.append(np.abs(now.contact.sum(axis=0) - load).max())
    return float(max(parts)) / scale


@dataclass(frozen=True)
class Launch:
    """What a motion wants next: substeps first..last of a path, then a Reading."""

    path: Path
    first: int
    last: int

    @property
    def held(self) -> bool:
        """Nothing is driven any more."""
        return self.path.substeps == 0

    @property
    def flowing(self) -> bool:
        """Of a motion that flows into the next."""
        return self.path.rates is not None


@dataclass(frozen=True)
class Prepared:
    """A launch that one environment is ready for: its grid is laid and its numbers are set."""

    launch: Launch
    drive: NDArray[np.float32]  # (n, frames, 6, 3) of the kernel
    where: Place
    good: State  # the environment's arrays before it


class Kernels(Protocol):
    """The arrays of some environments, and the kernel that advances them."""

    def advance(self, drives: Mapping[int, NDArray[np.float32]]) -> None:
        """One launch: every environment named goes along its own drive, however long; all others rest."""
        ...


class Environment(Protocol):
    """A world as one environment of such arrays."""

    def prepare(self, launch: Launch) -> Prepared:
        """Sets everything of this environment for the launch. Raises SimulationDiverged if it cannot be done."""
        ...

    def outcome(self, prepared: Prepared) -> Reading:
        """What the launch came to. Raises SimulationDiverged if that is unphysical."""
        ...


# The logic of one world's motion, which touches no kernel: it yields a Launch and is sent the Reading at its end, or
# thrown the SimulationDiverged that the launch ended in. So whoever advances many worlds in one launch of kernels holds
# one motion for each, all at their own phases; `run` is that for a single world.
Motion = Generator[Launch, Reading, MoveStats]


def run(motion: Motion, advance: Callable[[Path, int, int], Reading]) -> MoveStats:
    """Runs one world's motion to its end. A motion cut short (an interruption, say) is closed, so it rolls back."""
    try:
        wanted = next(motion)
        while True:
            try:
                reading = advance(wanted.path, wanted.first, wanted.last)
            except SimulationDiverged as failure:
                wanted = motion.throw(failure)
            else:
                wanted = motion.send(reading)
    except StopIteration as end:
        stats: MoveStats = end.value
        return stats
    finally:
        motion.close()


def advance_all(
    kernels: Kernels, environments: Sequence[Environment], wanted: Mapping[int, Launch]
) -> dict[int, Reading | SimulationDiverged]:
    """One launch of kernels for all environments that want one; what each came to, a failure in its own place only."""
    results: dict[int, Reading | SimulationDiverged] = {}
    ready: dict[int, Prepared] = {}
    for index, launch in wanted.items():
        try:
            ready[index] = environments[index].prepare(launch)
        except SimulationDiverged as failure:
            results[index] = failure
    if ready:
        kernels.advance({index: prepared.drive for index, prepared in ready.items()})
    for index, prepared in ready.items():
        try:
            results[index] = environments[index].outcome(prepared)
        except SimulationDiverged as failure:
            results[index] = failure
    return results


def move_and_settle(path: Path, settling: Settling, *, balanced: bool) -> Motion:
    """Goes along `path`, then holds at its end until the residual is within tolerance or the hold budget is spent."""
    seen = yield from _driven(path)
    rest = replace(path, start=path.end, substeps=0, rates=None)
    held, worst = 0, math.inf
    while held < settling.max_substeps:
        count = min(path.look, settling.max_substeps - held)
        seen.append((yield Launch(rest, 0, count)))
        held += count
        if len(seen) > LOOKS:
            worst = max(residual(seen[-1], earlier, balanced) for earlier in seen[-1 - LOOKS : -1])
            if worst <= settling.tolerance:
                break
    return _stats(seen, path.substeps, held, worst, settling)


def move_in_time(path: Path, settling: Settling, *, balanced: bool) -> Motion:
    """Goes along `path` and holds nowhere; the residual says how far from rest the scene is at the end."""
    seen = yield from _driven(path)
    worst = residual(seen[-1], seen[-2], balanced) if len(seen) > 1 else math.inf
    return _stats(seen, path.substeps, 0, worst, settling)


def move_on(path: Path, settling: Settling, *, balanced: bool) -> Motion:
    """Goes along `path`, whose end is no rest; the residual is the imbalance of forces there."""
    if not path.substeps:
        return (yield from move_and_settle(path, settling, balanced=balanced))
    seen = yield from _driven(path)
    stats = _stats(seen, path.substeps, 0, residual(seen[-1], seen[-1], balanced), settling)
    return replace(stats, settled=False)


def come_to_rest(path: Path, motion: Motion) -> Motion:
    """Goes along `path`, then does `motion`."""
    yield from _driven(path)
    stats = yield from motion
    return replace(stats, substeps=path.substeps + stats.substeps)


def _driven(path: Path) -> Generator[Launch, Reading, list[Reading]]:
    seen: list[Reading] = []
    for first in range(0, path.substeps, PIECE):
        seen.append((yield Launch(path, first, min(first + PIECE, path.substeps))))
    return seen


def _stats(seen: Sequence[Reading], substeps: int, held: int, worst: float, settling: Settling) -> MoveStats:
    overlap = seen[-1].overlap / MM if seen else 0.0
    hits = sum(reading.guard_hits for reading in seen)
    return MoveStats(substeps + held, held, worst, worst <= settling.tolerance, overlap, hits)


def merged(poses: Mapping[str, Pose], targets: Mapping[str, Pose]) -> dict[str, Pose]:
    """Where every driven frame ends. Raises KeyError for a frame that is not driven."""
    unknown = sorted(set(targets) - set(poses))
    if unknown:
        raise KeyError(f"no driven frame {', '.join(unknown)}; this world drives {', '.join(poses)}")
    return {**poses, **targets}
